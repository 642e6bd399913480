"""A part of a photograph that is asked for alone, and the surroundings it is read with."""

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from service.errors import BadRequest
from service.optics.camera import Camera


@dataclass(frozen=True, slots=True)
class Part:
    """Columns ``left`` (included) to ``right`` (excluded) and rows ``top`` to ``bottom``, in pixels."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def width_px(self) -> int:
        return self.right - self.left

    @property
    def height_px(self) -> int:
        return self.bottom - self.top

    def of(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """The part of a picture or map [h, w, ...], as a view."""
        return pixels[self.top : self.bottom, self.left : self.right]

    def cells_of(self, cells: NDArray[Any], size: tuple[int, int]) -> NDArray[Any]:
        """What of cells [h, w] all over a photograph of that size (height, width) the part touches, as a view."""
        (down, across), (height, width) = cells.shape[:2], size
        return cells[
            self.top * down // height : -(-self.bottom * down // height),
            self.left * across // width : -(-self.right * across // width),
        ]

    def behind(self, camera: Camera) -> Camera:
        """The camera of a photograph as the one behind this part of it."""
        return camera.cropped(self.left, self.top, self.width_px, self.height_px)

    def require_within(self, width_px: int, height_px: int) -> None:
        """Raises ``BadRequest`` where it is empty or leaves a photograph of that size."""
        if not (0 <= self.left < self.right <= width_px and 0 <= self.top < self.bottom <= height_px):
            raise BadRequest.at(
                f"({self.left}, {self.top}) to ({self.right}, {self.bottom}) is not within the upright photograph of "
                f"{width_px}x{height_px} pixels.",
                "roi",
            )

    def widened(self, margin_px: int, multiple: int, width_px: int, height_px: int) -> "Part":
        """The part with a margin on every side, as far as the photograph goes, from multiples."""
        return Part(
            max(0, self.left - margin_px) // multiple * multiple,
            max(0, self.top - margin_px) // multiple * multiple,
            min(width_px, self.right + margin_px),
            min(height_px, self.bottom + margin_px),
        )

    def within(self, outer: "Part") -> "Part":
        """This part in the pixels of one that holds it."""
        return Part(self.left - outer.left, self.top - outer.top, self.right - outer.left, self.bottom - outer.top)
