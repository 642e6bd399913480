"""A camera as depth needs it: blur constants at a stated image size, focus distance and intrinsics."""

import math
from dataclasses import dataclass, replace
from typing import Self

from service.optics import thin_lens

RANGE_BLUR_ERROR_PX = 0.25
RANGE_DEPTH_ERROR = 0.1
ASPECT_TOLERANCE = 0.01
F_NUMBERS = (0.5, 1_000.0)  # in air, light from a half space is the least; the fastest lens that was made is f/0.7
FOCUS_DISTANCES_M = (0.001, 100_000.0)  # that can be told; the farthest stands for infinity
AS_INFINITY_M = 50.0  # from where on no ring has a figure but that of infinity


@dataclass(frozen=True, slots=True)
class Lens:
    """Raw lens specs (eq. 2). The focal length is the real one, never the 35-mm equivalent."""

    focal_length_mm: float
    f_number: float
    pixel_pitch_um: float
    sensor_width_px: int
    k_r: float = thin_lens.K_R_OF_DISC

    @property
    def focal_length_m(self) -> float:
        return self.focal_length_mm * 1e-3

    @property
    def sensor_width_mm(self) -> float:
        """Of what the pictures show of the sensor."""
        return self.pixel_pitch_um * 1e-3 * self.sensor_width_px

    def k_cam_px(self, focus_distance_m: float, image_width_px: int) -> float:
        """k_cam at the given focus distance and image width; ``ValueError`` if f >= s1."""
        return thin_lens.k_cam(
            self.focal_length_m,
            self.f_number,
            focus_distance_m,
            self.pixel_pitch_um * 1e-6,
            image_width_px / self.sensor_width_px,
            self.k_r,
        )

    def fx_px(self, image_width_px: int) -> float:
        """Focal length in pixels of an image of the given width (infinity focus)."""
        return self.focal_length_mm * 1e3 / self.pixel_pitch_um * image_width_px / self.sensor_width_px


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """Pinhole intrinsics in pixels; pixel (0, 0) is the centre of the top left pixel."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] = ()

    @classmethod
    def centred(cls, fx_px: float, width_px: int, height_px: int) -> Self:
        """Square pixels, the axis in the middle of the picture, no distortion."""
        return cls(fx_px, fx_px, (width_px - 1) / 2, (height_px - 1) / 2)

    @property
    def matrix(self) -> tuple[tuple[float, float, float], ...]:
        """K, row by row: from a direction (x, y, 1) to pixels, without distortion."""
        return (self.fx_px, 0.0, self.cx_px), (0.0, self.fy_px, self.cy_px), (0.0, 0.0, 1.0)

    def scaled(self, x_ratio: float, y_ratio: float) -> "Intrinsics":
        """The same camera after a resize by these ratios; distortion has no unit and stays."""
        return Intrinsics(
            self.fx_px * x_ratio,
            self.fy_px * y_ratio,
            (self.cx_px + 0.5) * x_ratio - 0.5,
            (self.cy_px + 0.5) * y_ratio - 0.5,
            self.distortion,
        )

    def turned(self, transposed: bool, flip_u: bool, flip_v: bool, size_px: tuple[int, int]) -> "Intrinsics":
        """The same camera after its picture was transposed, then flipped along u, then along v.

        ``size_px`` is the width and height after the transposition. Tangential, thin-prism and tilt terms turn with the
        picture; transposed, two tilts at once do so but for half their product.
        """
        fx_px, fy_px, cx_px, cy_px = self.fx_px, self.fy_px, self.cx_px, self.cy_px
        terms = list(self.distortion)
        if transposed:
            fx_px, fy_px, cx_px, cy_px = fy_px, fx_px, cy_px, cx_px
            terms[2:4] = terms[3:1:-1]
            terms[8:12] = terms[10:12] + terms[8:10]
            terms[12:14] = [-term for term in terms[:11:-1]]
        if flip_u:
            cx_px = size_px[0] - 1 - cx_px
            terms = [-term if place in (3, 8, 9, 13) else term for place, term in enumerate(terms)]
        if flip_v:
            cy_px = size_px[1] - 1 - cy_px
            terms = [-term if place in (2, 10, 11, 12) else term for place, term in enumerate(terms)]
        return Intrinsics(fx_px, fy_px, cx_px, cy_px, tuple(terms))


@dataclass(frozen=True, slots=True)
class Camera:
    """What turns blur into metres, at one image size and one focus distance.

    ``k_cam_px`` and ``gamma_px`` hold at ``image_width_px``. ``focal_length_m`` (real, not equivalent) is
    needed only to move the focus exactly, ``f_number``, at which ``k_cam_px`` holds, only to know other photographs.
    Raises ``ValueError`` naming the field that is out of bounds.
    """

    image_width_px: int
    image_height_px: int
    focus_distance_m: float
    k_cam_px: float
    gamma_px: float = 0.5
    focal_length_m: float | None = None
    intrinsics: Intrinsics | None = None
    f_number: float | None = None

    def __post_init__(self) -> None:
        for name in ("image_width_px", "image_height_px", "focus_distance_m", "k_cam_px"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be a positive number, not {value}")
        if not (math.isfinite(self.gamma_px) and self.gamma_px >= 0):
            raise ValueError(f"gamma_px must be zero or a positive number, not {self.gamma_px}")
        if self.focal_length_m is not None and not 0 < self.focal_length_m < self.focus_distance_m:
            raise ValueError("focal_length_m must be positive and shorter than focus_distance_m")

    @property
    def range_m(self) -> tuple[float, float]:
        """Nearest and farthest depth where 0.25 px of blur error moves the depth by less than 10 %."""
        far = thin_lens.farthest_depth(self.focus_distance_m, self.k_cam_px, RANGE_BLUR_ERROR_PX, RANGE_DEPTH_ERROR)
        return min(self.focal_length_m or 0.0, far), far

    @property
    def middle_m(self) -> float:
        """What a curve of blur is drawn around: the plane in focus, or the range's end if that is all but infinity."""
        focus_m = self.focus_distance_m
        return min(focus_m, self.range_m[1]) if focus_m >= AS_INFINITY_M else focus_m

    def is_same_frame(self, width_px: int, height_px: int) -> bool:
        """Whether an image of this size can be this camera's whole frame, resized (same aspect to 1 %)."""
        aspect = (width_px / height_px) / (self.image_width_px / self.image_height_px)
        # one pixel of rounding is no crop, however small the copy is
        rounding = 0.5 / width_px + 0.5 / height_px
        return abs(aspect - 1) <= max(ASPECT_TOLERANCE, rounding)

    def resized(self, width_px: int, height_px: int) -> "Camera":
        """The camera behind the same frame at another size: k_cam, gamma and intrinsics scale, x does not."""
        if (width_px, height_px) == (self.image_width_px, self.image_height_px):
            return self
        ratio = width_px / self.image_width_px
        scaled = self.intrinsics and self.intrinsics.scaled(ratio, height_px / self.image_height_px)
        return replace(
            self,
            image_width_px=width_px,
            image_height_px=height_px,
            k_cam_px=self.k_cam_px * ratio,
            gamma_px=self.gamma_px * ratio,
            intrinsics=scaled,
        )

    def resampled(self, width_px: int, height_px: int) -> "Camera":
        """The camera behind a copy that whatever program made: a smaller one's pixels are as wide as any others."""
        resized = self.resized(width_px, height_px)
        if width_px >= self.image_width_px:
            return resized
        gamma_px = thin_lens.gamma_after_shrinking(self.gamma_px, width_px / self.image_width_px)
        return replace(resized, gamma_px=gamma_px)

    def averaged(self, width_px: int, height_px: int) -> "Camera":
        """The camera behind a copy made smaller by averaging areas, whose gamma has a pixel's box again."""
        if (width_px, height_px) == (self.image_width_px, self.image_height_px):
            return self
        gamma_px = thin_lens.gamma_after_averaging(self.gamma_px, self.image_width_px, width_px)
        return replace(self.resized(width_px, height_px), gamma_px=gamma_px)

    def cropped(self, left_px: int, top_px: int, width_px: int, height_px: int) -> "Camera":
        """The camera behind a part of its picture: only the principal point moves."""
        known = self.intrinsics
        moved = known and replace(known, cx_px=known.cx_px - left_px, cy_px=known.cy_px - top_px)
        return replace(self, image_width_px=width_px, image_height_px=height_px, intrinsics=moved)

    def turned(self, transposed: bool, flip_u: bool, flip_v: bool) -> "Camera":
        """The camera behind the same picture transposed, then flipped along u, then along v; k_cam stays."""
        size_px = (self.image_width_px, self.image_height_px)
        if transposed:
            size_px = (self.image_height_px, self.image_width_px)
        intrinsics = self.intrinsics and self.intrinsics.turned(transposed, flip_u, flip_v, size_px)
        return replace(self, image_width_px=size_px[0], image_height_px=size_px[1], intrinsics=intrinsics)

    def focused_at(self, focus_distance_m: float) -> "Camera":
        """The same camera focused elsewhere; without a known focal length f << s1 is assumed.

        Raises ``ValueError`` if the lens cannot focus there.
        """
        k_cam_px = thin_lens.k_cam_at_focus(
            self.k_cam_px, self.focal_length_m or 0.0, self.focus_distance_m, focus_distance_m
        )
        return replace(self, k_cam_px=k_cam_px, focus_distance_m=focus_distance_m)

    def blurring_alike(self, focus_distance_m: float) -> "Camera":
        """The camera focused there whose blur is this one's at ``thin_lens.depth_at_focus`` of every depth."""
        k_cam_px = self.k_cam_px * (self.focus_distance_m / focus_distance_m)
        return replace(self, focus_distance_m=focus_distance_m, k_cam_px=k_cam_px)

    def seen_through(self, lens: Lens) -> "Camera":
        """The same camera with the intrinsics its lens implies: square pixels, the axis in the middle."""
        size_px = (self.image_width_px, self.image_height_px)
        return replace(self, intrinsics=Intrinsics.centred(lens.fx_px(self.image_width_px), *size_px))

    def blur_px(self, depth_m: float) -> float:
        """lambda this camera shows at a depth."""
        return thin_lens.blur_at_depth(depth_m, self.focus_distance_m, self.k_cam_px, self.gamma_px)
