"""What a calibration tells: of every picture, of every circle, and of the camera; and what a look does."""

from dataclasses import dataclass
from typing import Literal

from service.optics.camera import Camera, Intrinsics

Role = Literal["focused", "defocused"]
Method = Literal["edge", "paper"]
Shape = Literal["gaussian", "disc"]
Exposure = Literal["good", "over", "under"]


@dataclass(frozen=True, slots=True)
class Interval:
    """A value and where it lies with a confidence of 95 %."""

    value: float
    low: float
    high: float

    @property
    def relative_width(self) -> float:
        return (self.high - self.low) / self.value


@dataclass(frozen=True, slots=True)
class CurvePoint:
    """Lambda at one depth by the constants found, and where it lies with a confidence of 95 %."""

    depth_m: float
    blur_px: float
    low_px: float
    high_px: float


@dataclass(frozen=True, slots=True)
class PictureReport:
    """One photograph: whether its grid was found, how many circles were measured, and where the grid stood.

    ``blur_px`` is the median lambda of its circles, ``distance_m`` the depth of the grid's middle along the axis and
    ``tilt_deg`` the angle between the grid and the sensor; None as long as they are not known.
    """

    name: str
    role: Role
    found: bool
    circles: int = 0
    blur_px: float | None = None
    distance_m: float | None = None
    tilt_deg: float | None = None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Sample:
    """One measured circle. ``circle`` is its number in the grid, row by row; ``image`` the picture's name; (u, v) where
    its centre is there.

    ``k_cam_px`` is what this circle alone says; None in the plane of focus, where it says nothing. An outlier is
    shown with ``used`` False.
    """

    circle: int
    image: str
    u_px: float
    v_px: float
    depth_m: float
    blur_px: float
    blur_error_px: float
    k_cam_px: float | None
    used: bool


@dataclass(frozen=True, slots=True)
class Result:
    """The camera's constants with 95 % intervals, in pixels of pictures of this size, and what they rest on.

    ``focus_distance_m`` is an interval of no width where the user gave it; ``point_spread`` is the shape of defocus
    that fits the circles better; ``corner_ratio`` is k_cam in the corners over that in the middle, if both were seen,
    ``f_number`` the aperture that the photographs' EXIF tells, if it is one.
    """

    image_width_px: int
    image_height_px: int
    k_cam_px: Interval
    gamma_px: Interval
    focus_distance_m: Interval
    point_spread: Shape
    intrinsics: Intrinsics
    reprojection_rms_px: float
    samples: tuple[Sample, ...]
    curve: tuple[CurvePoint, ...]
    corner_ratio: float | None = None
    f_number: float | None = None
    warnings: tuple[str, ...] = ()

    def to_camera(self) -> Camera:
        """The camera it found, focused as it was."""
        return Camera(
            image_width_px=self.image_width_px,
            image_height_px=self.image_height_px,
            focus_distance_m=self.focus_distance_m.value,
            k_cam_px=self.k_cam_px.value,
            gamma_px=self.gamma_px.value,
            f_number=self.f_number,
            intrinsics=self.intrinsics,
        )


@dataclass(frozen=True, slots=True)
class Report:
    """A finished calibration: either a result, or the problem, in words for the user, that there is none."""

    pictures: tuple[PictureReport, ...]
    result: Result | None
    problem: str | None


@dataclass(frozen=True, slots=True)
class Circle:
    """Where a printed circle is in the picture, and about how large."""

    u_px: float
    v_px: float
    radius_px: float


@dataclass(frozen=True, slots=True)
class Look:
    """What one photograph shows; None for what it does not tell.

    ``circles`` are all of the grid, row by row, those too that were filled in from their neighbours. At most a dozen,
    in all columns, are measured; ``measured`` gave a blur, and ``blur_px`` is its median. ``paper_level`` is how bright
    the white between them is, 0 to 1.
    """

    width_px: int
    height_px: int
    circles: tuple[Circle, ...] = ()
    measured: int = 0
    blur_px: float | None = None
    distance_m: float | None = None
    tilt_deg: float | None = None
    exposure: Exposure | None = None
    paper_level: float | None = None
    warnings: tuple[str, ...] = ()

    @property
    def found(self) -> bool:
        return bool(self.circles)
