"""What ``POST /depth`` can be asked, and its answer in numbers."""

import re
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from service.inference.known import KnownDepth
from service.inference.pair import Side
from service.inference.part import Part

ROI = r"^\d{1,6},\d{1,6},\d{1,6},\d{1,6}$"
MAX_POINTS = 1000
MAX_KNOWN = 100
POINT = r"^-?\d{1,6}(\.\d{1,6})?,-?\d{1,6}(\.\d{1,6})?$"
KNOWN = POINT[:-1] + r",([1-9]\d{0,4}(\.\d{1,6})?|0\.0{0,2}[1-9]\d{0,5})$"


def _require_point(value: str) -> str:
    if not re.fullmatch(POINT, value):
        raise ValueError("a point is two numbers of pixels, u,v: for instance 320,216")
    return value


def _require_known(value: str) -> str:
    if not re.fullmatch(KNOWN, value):
        raise ValueError("a known depth is a pixel and metres from 0.001 on, u,v,depth_m: for instance 320,216,1.25")
    return value


Point = Annotated[str, AfterValidator(_require_point), Field(json_schema_extra={"pattern": POINT})]
Known = Annotated[str, AfterValidator(_require_known), Field(json_schema_extra={"pattern": KNOWN})]


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
    roi: Annotated[
        str | None,
        Field(
            pattern=ROI,
            description="Part u0,v0,u1,v1 of the upright photograph to answer alone; u1 and v1 lie outside it",
        ),
    ] = None
    focus_distance_m: Annotated[
        float | None,
        Field(ge=0.001, le=100_000, allow_inf_nan=False, description="This shot's focus distance, if not the camera's"),
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
        return [KnownDepth(*map(float, text.split(","))) for text in self.known]

    @property
    def points(self) -> list[tuple[float, float]]:
        """The pixels asked for, (u, v)."""
        return [(_number(u), _number(v)) for u, v in (text.split(",") for text in self.at)]

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


class PointRead(BaseModel):
    """Depth at one pixel: metres along the optical axis, one standard deviation, and the other hypothesis."""

    model_config = ConfigDict(from_attributes=True)

    u: int | float
    v: int | float
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


def _number(text: str) -> float:
    return float(text) if "." in text else int(text)
