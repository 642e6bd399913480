"""Calibrations on the wire; what they found has the fields of ``service.calibration.report``."""

from dataclasses import asdict
from datetime import datetime
from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationError

from service.api.camera_schemas import FocusDistance, Given, IntrinsicsRead, Name
from service.api.cursors import NextCursor
from service.api.problems import invalid_request
from service.calibration.report import Exposure, Look, Method, Role, Shape
from service.calibration.target import CircleGrid, Kind
from service.errors import BadRequest
from service.inference.frame import FocalLengthFrom
from service.storage.calibrations import State

SETTINGS_FIELD = "settings"

Circles = Annotated[int, Field(ge=2, le=40)]
Millimetres = Annotated[float, Field(gt=0, le=1_000, allow_inf_nan=False)]
Utc = Annotated[datetime, Field(description="UTC")]
EXAMPLE: dict[str, JsonValue] = {
    "pattern": {"kind": "asymmetric_circles", "rows": 11, "columns": 4, "spacing_mm": 20.0, "diameter_mm": 12.0},
    "focus_distance_m": None,
    "method": "edge",
    "register": True,
}


class Pattern(Given):
    """The printed grid of circles; its true sizes, for the camera's scale hangs on them."""

    kind: Annotated[Kind, Field(description="Circle (row i, column j) stands at ((2j + i mod 2)s, is) or at (js, is)")]
    rows: Circles
    columns: Circles
    spacing_mm: Annotated[Millimetres, Field(description="The spacing s of the grid, as printed")]
    diameter_mm: Annotated[Millimetres, Field(description="Of each circle, as printed")]


class CalibrationSettings(Given):
    """What to look for in the photographs, and what to do with what is found."""

    model_config = ConfigDict(serialize_by_alias=True, json_schema_extra={"examples": [EXAMPLE]})

    pattern: Pattern
    focus_distance_m: Annotated[
        FocusDistance | None,
        Field(description="Where the lens is focused; null: find it, which the method `paper` cannot"),
    ] = None
    method: Annotated[Method, Field(description="How the blur of a circle is read")] = "edge"
    # "register" is what every class of models can do already
    is_to_register: Annotated[
        bool, Field(alias="register", description="Store the camera, or its new revision, on success")
    ] = False

    @classmethod
    def from_form(cls, raw: bytes) -> Self:
        """The settings in a form's field. Raises ``BadRequest`` that points below the field."""
        try:
            settings = cls.model_validate_json(raw)
        except ValidationError as exc:
            raise invalid_request([_in_field(dict(fault)) for fault in exc.errors()]) from exc
        settings.to_grid()
        if settings.method == "paper" and settings.focus_distance_m is None:
            detail = "The paper's method needs the focus distance: it cannot find it."
            raise BadRequest.at(detail, f"#/{SETTINGS_FIELD}/focus_distance_m")
        return settings

    def to_grid(self) -> CircleGrid:
        """The grid; ``BadRequest`` for circles that touch."""
        given = self.pattern
        try:
            return CircleGrid(given.kind, given.rows, given.columns, given.spacing_mm, given.diameter_mm)
        except ValueError as exc:
            detail = f"No such grid can be printed: {exc}."
            raise BadRequest.at(detail, f"#/{SETTINGS_FIELD}/pattern/diameter_mm") from exc


class Acceptance(Given):
    """Where an accepted calibration goes."""

    camera: Annotated[
        Name | None, Field(description="A new camera, or one that gets a revision; null: the calibration's own name")
    ] = None


class ImageRead(BaseModel):
    """What one photograph gave; null where it is not known."""

    name: Annotated[str, Field(description="The file's name, numbered where two were the same")]
    role: Role
    found: Annotated[bool, Field(description="Whether the grid was found")]
    circles: Annotated[int, Field(description="Circles measured")]
    blur_px: Annotated[float | None, Field(description="Median blur of its circles, a standard deviation")]
    distance_m: Annotated[float | None, Field(description="Depth of the grid's middle, along the optical axis")]
    tilt_deg: Annotated[float | None, Field(description="Between grid and sensor")]
    warnings: list[str]


class IntervalRead(BaseModel):
    """A value and where it lies with a confidence of 95 %."""

    value: float
    low: float
    high: float


class SampleRead(BaseModel):
    """One measured circle."""

    circle: Annotated[int, Field(description="Its number in the grid, row by row")]
    image: Annotated[str, Field(description="The photograph's name")]
    u_px: Annotated[float, Field(description="Where its centre is, before EXIF orientation")]
    v_px: float
    depth_m: Annotated[float, Field(description="Along the optical axis")]
    blur_px: float
    blur_error_px: Annotated[float, Field(description="Standard error of `blur_px`")]
    k_cam_px: Annotated[float | None, Field(description="What this circle alone says; null in the plane in focus")]
    used: Annotated[bool, Field(description="False for an outlier")]


class CurvePointRead(BaseModel):
    """The blur that the constants give at one distance, and where it lies with a confidence of 95 %."""

    depth_m: float
    blur_px: float
    low_px: float
    high_px: float


class ResultRead(BaseModel):
    """The camera's constants, in pixels of images of this size as the sensor has them, before EXIF orientation."""

    image_width_px: int
    image_height_px: int
    k_cam_px: IntervalRead
    gamma_px: IntervalRead
    focus_distance_m: Annotated[IntervalRead, Field(description="Of no width where it was given")]
    point_spread: Annotated[Shape, Field(description="The shape of defocus that fits the circles better")]
    intrinsics: IntrinsicsRead
    reprojection_rms_px: Annotated[float, Field(description="How well the circles' places fit the lens")]
    samples: list[SampleRead]
    curve: Annotated[list[CurvePointRead], Field(description="The fitted blur over the distances measured")]
    corner_ratio: Annotated[
        float | None, Field(description="k_cam in the corners over that in the middle; null where too few circles were")
    ] = None
    f_number: Annotated[
        float | None,
        Field(description="Aperture of the photographs by their EXIF; null where it tells none or several"),
    ] = None
    warnings: list[str]


class CircleRead(BaseModel):
    """Where one circle of the grid is in a photograph."""

    u_px: Annotated[float, Field(description="Its centre, before EXIF orientation")]
    v_px: float
    radius_px: Annotated[float, Field(description="About; the mean of a tilted circle's two")]


class LookRead(BaseModel):
    """What one photograph of the sheet shows; null where it is not known."""

    found: Annotated[bool, Field(description="Whether the grid was found")]
    width_px: Annotated[int, Field(description="As the sensor had it, before EXIF orientation")]
    height_px: int
    orientation: Annotated[int, Field(ge=1, le=8, description="EXIF's: how a viewer turns the photograph")]
    circles: Annotated[list[CircleRead], Field(description="All of the grid, row by row")]
    measured: Annotated[int, Field(description="How many gave a blur, of up to a dozen looked at")]
    blur_px: Annotated[float | None, Field(description="Median blur of its circles, a standard deviation")]
    distance_m: Annotated[float | None, Field(description="Depth of the grid's middle, along the optical axis")]
    tilt_deg: Annotated[float | None, Field(description="Between grid and sensor")]
    focal_length_from: Annotated[
        FocalLengthFrom | None,
        Field(description="What distance and tilt rest on; EXIF's is a few percent off"),
    ]
    exposure: Annotated[Exposure | None, Field(description="`over`: white is clipped, which sharpens edges")]
    paper_level: Annotated[float | None, Field(ge=0, le=1, description="How bright the white between the circles is")]
    warnings: list[str]

    @classmethod
    def from_look(cls, seen: Look, orientation: int, focal_length_from: FocalLengthFrom | None) -> Self:
        """What was seen, with how the photograph is to be turned."""
        more = {"found": seen.found, "orientation": orientation, "focal_length_from": focal_length_from}
        return cls.model_validate(asdict(seen) | more)


class CalibrationItem(BaseModel):
    """A calibration in a list."""

    model_config = ConfigDict(from_attributes=True, serialize_by_alias=True)

    id: str
    camera: Name
    state: Annotated[State, Field(description="The last three are final")]
    progress: Annotated[float, Field(ge=0, le=1)]
    problem: Annotated[str | None, Field(description="Why there is no result, once it has failed")]
    camera_revision: Annotated[
        int | None, Field(description="The revision it gave the camera, where it registered one")
    ]
    created_at: Utc
    updated_at: Utc


class CalibrationPage(BaseModel):
    """Calibrations, the newest first."""

    items: list[CalibrationItem]
    next_cursor: NextCursor


class CalibrationRead(CalibrationItem):
    """A calibration: how far it is, what each photograph gave so far, and the result once it has succeeded."""

    settings: CalibrationSettings
    images: Annotated[list[ImageRead], Field(description="The photographs looked at so far")]
    result: ResultRead | None


def _in_field(fault: dict[str, object]) -> dict[str, object]:
    path = fault["loc"] if isinstance(fault["loc"], tuple) else ()
    # JSON that is none has its place in its message: elsewhere it would point to the whole body
    kind = "json" if fault["type"] == "json_invalid" else fault["type"]
    return {**fault, "type": kind, "loc": ("body", SETTINGS_FIELD, *path)}
