"""What ``POST /depth`` can be asked, and its answer in numbers."""

from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, WithJsonSchema

from service.api.camera_schemas import FocusDistance
from service.api.texts import Worded, numbers_in
from service.inference.encode import MAPS, MapName
from service.inference.known import KnownDepth
from service.inference.pair import Side
from service.inference.part import Part

MAX_POINTS = 1000
MAX_KNOWN = 100
MOST_PIXELS = 1_000_000
DEPTHS_M = (0.001, 100_000)
# the plainest forms of what is read, for programs; numbers may be written in any other way, too
ROI = r"^\d{1,6},\d{1,6},\d{1,6},\d{1,6}$"
POINT = r"^-?\d{1,6}(\.\d{1,20})?,-?\d{1,6}(\.\d{1,20})?$"
KNOWN = POINT[:-1] + r",([1-9]\d{0,4}(\.\d{1,20})?|0\.0{0,2}[1-9]\d{0,20})$"


def _point_in(text: str) -> tuple[float, float]:
    u, v = numbers_in(text)
    if max(abs(u), abs(v)) >= MOST_PIXELS:
        raise ValueError("no photograph has so many pixels")
    return u, v


def _known_in(text: str) -> KnownDepth:
    pixel, _, depth = text.rpartition(",")
    (depth_m,) = numbers_in(depth)
    if not DEPTHS_M[0] <= depth_m <= DEPTHS_M[1]:
        raise ValueError("no such depth")
    return KnownDepth(*_point_in(pixel), depth_m)


def _require_point(text: str) -> str:
    try:
        _point_in(text)
    except ValueError:
        raise ValueError("a point is two numbers of pixels, u,v: for instance 320,216") from None
    return text


def _require_known(text: str) -> str:
    try:
        _known_in(text)
    except ValueError:
        words = "a known depth is a pixel and metres from 0.001 on, u,v,depth_m: for instance 320,216,1.25"
        raise ValueError(words) from None
    return text


Point = Annotated[str, AfterValidator(_require_point), Field(json_schema_extra={"pattern": POINT})]
Known = Annotated[str, AfterValidator(_require_known), Field(json_schema_extra={"pattern": KNOWN})]
Corners = Annotated[str, Worded(ROI, "a part is four whole numbers of pixels, u0,v0,u1,v1: for instance 0,0,320,216")]


class DepthQuery(BaseModel):
    """What can be asked of a photograph."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    camera: Annotated[str, Field(min_length=1, max_length=200, description="Name of the camera that took it")]
    side: Annotated[
        Side, Field(description="Where what is measured lies: nearer than the plane in focus, beyond it, or unknown")
    ] = "auto"
    format: Annotated[
        Literal["png", "npy", "npz", "tiff", "ply", "preview", "json"] | None,
        Field(description="Form of the answer; wins over Accept. Default png"),
    ] = None
    at: Annotated[
        tuple[Point, ...],
        Field(max_length=MAX_POINTS, description="Pixels u,v to read, repeatable; answered in json"),
    ] = ()
    maps: Annotated[
        tuple[MapName, ...],
        Field(max_length=len(MAPS), description="Maps that an npz holds, repeatable; without it all of them"),
    ] = ()
    roi: Annotated[
        Corners | None,
        Field(description="Part u0,v0,u1,v1 of the upright photograph to answer alone; u1 and v1 lie outside it"),
    ] = None
    longest_px: Annotated[
        int | None,
        Field(
            ge=16, le=100_000, description="Longer side of the map at most; it is never enlarged. Without it full size"
        ),
    ] = None
    focus_distance_m: Annotated[
        FocusDistance | None,
        Field(description="This shot's focus distance in metres, if not the camera's; 100000 stands for infinity"),
    ] = None

    known: Annotated[
        tuple[Known, ...],
        Field(
            max_length=MAX_KNOWN,
            description="Known depths u,v,depth_m, repeatable: focus distance and gamma are fitted to them",
        ),
    ] = ()

    @property
    def known_depths(self) -> list[KnownDepth]:
        """What is known of the photograph."""
        return [_known_in(text) for text in self.known]

    @property
    def points(self) -> list[tuple[float, float]]:
        """The pixels asked for, (u, v)."""
        return [_point_in(text) for text in self.at]

    @property
    def part(self) -> Part | None:
        """The part asked for; None for all of the photograph."""
        return Part(*map(int, self.roi.split(","))) if self.roi is not None else None


class SpreadRead(BaseModel):
    """Depth over the pixels with an answer, in metres; null without one."""

    model_config = ConfigDict(from_attributes=True)

    min: float | None
    p5: float | None
    median: float | None
    p95: float | None
    max: float | None


# whole numbers are written without a point
Coordinate = Annotated[
    int | float,
    BeforeValidator(lambda number: int(number) if number % 1 == 0 else number),
    WithJsonSchema({"type": "number"}),
]


class PointRead(BaseModel):
    """Depth at one pixel: metres along the optical axis, one standard deviation, and the other hypothesis."""

    model_config = ConfigDict(from_attributes=True)

    u: Coordinate
    v: Coordinate
    depth_m: float | None
    depth_alt_m: float | None
    sigma_m: float | None
    p_near: Annotated[float, Field(ge=0, le=1)]


class DepthRead(BaseModel):
    """The answer to a photograph in numbers."""

    camera: str
    revision: int
    model: str
    width_px: int
    height_px: int
    depth_m: SpreadRead
    valid_fraction: Annotated[float, Field(ge=0, le=1)]
    points: list[PointRead]
    warnings: list[str]
