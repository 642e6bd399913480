"""Cameras on the wire. Unknown fields, strings for numbers, NaN and infinity are refused."""

from dataclasses import asdict
from datetime import datetime
from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, JsonValue

from service.api.cursors import NextCursor
from service.api.texts import Worded
from service.errors import BadRequest
from service.optics.camera import F_NUMBERS, FOCUS_DISTANCES_M, Camera, Intrinsics, Lens
from service.optics.thin_lens import K_R_OF_DISC
from service.storage.cameras import NAME_PATTERN, CameraDraft, CameraRecord, Source

DISTORTION_LENGTHS = (0, 4, 5, 8, 12, 14)
PLAIN_TEXT = r"^[^\x00-\x08\x0b\x0c\x0e-\x1f\x7f]*$"
NO_CONTROLS = "a description has no control characters except tabs and line breaks, and no unpaired surrogates"

A_NAME = "a name has up to 64 letters, digits, dots, dashes and underscores, and begins with a letter or digit"

Name = Annotated[
    str,
    Worded(NAME_PATTERN, A_NAME),
    Field(description="Unique; stands in the camera's URL", examples=["d200"]),
]
Pixels = Annotated[int, Field(gt=0, le=100_000)]
FocusDistance = Annotated[float, Field(ge=FOCUS_DISTANCES_M[0], le=FOCUS_DISTANCES_M[1], allow_inf_nan=False)]
FNumber = Annotated[float, Field(ge=F_NUMBERS[0], le=F_NUMBERS[1], allow_inf_nan=False)]
BlurPixels = Annotated[float, Field(ge=1e-6, le=1_000_000, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False, ge=-1e9, le=1e9)]


class Given(BaseModel):
    """A body as sent: nothing unknown, nothing converted."""

    model_config = ConfigDict(extra="forbid", strict=True)


class LensSpecs(Given):
    """Raw lens specs, from which k_cam follows (eq. 2)."""

    focal_length_mm: Annotated[
        float,
        Field(ge=0.1, le=10_000, allow_inf_nan=False, description="Real focal length, never the 35-mm equivalent"),
    ]
    f_number: Annotated[FNumber, Field(description="Aperture number N; in air no lens has less than 0.5")]
    pixel_pitch_um: Annotated[
        float, Field(ge=0.01, le=1_000, allow_inf_nan=False, description="Pitch of one sensor pixel")
    ]
    sensor_width_px: Annotated[
        Pixels,
        Field(
            description="What the images show of the sensor, along their width, in its own pixels: all of it but in a "
            "crop mode; of tall images its short side"
        ),
    ]
    k_r: Annotated[
        float,
        Field(
            ge=0.01,
            le=100,
            allow_inf_nan=False,
            description="Diameter of the circle of confusion over its standard deviation; a disc has 4",
        ),
    ] = K_R_OF_DISC

    def to_domain(self) -> Lens:
        """The lens as the physics takes it."""
        return Lens(self.focal_length_mm, self.f_number, self.pixel_pitch_um, self.sensor_width_px, self.k_r)


class PinholeIntrinsics(Given):
    """Pinhole intrinsics at the camera's image size; pixel (0, 0) is the centre of the top left pixel."""

    fx_px: BlurPixels
    fy_px: BlurPixels
    cx_px: Finite
    cy_px: Finite
    distortion: Annotated[
        list[Finite],
        Field(
            max_length=14,
            description="OpenCV's order: 0, 4, 5, 8, 12 or 14 coefficients, never its fisheye model's (equidistant)",
        ),
    ] = []

    def to_domain(self) -> Intrinsics:
        """The intrinsics as the physics takes them; ``BadRequest`` for a count OpenCV does not know."""
        if len(self.distortion) not in DISTORTION_LENGTHS:
            detail = "Send 0, 4, 5, 8, 12 or 14 coefficients, in OpenCV's order."
            raise BadRequest.at(detail, "#/intrinsics/distortion")
        return Intrinsics(self.fx_px, self.fy_px, self.cx_px, self.cy_px, tuple(self.distortion))


class IntrinsicsRead(BaseModel):
    """Pinhole intrinsics as stored: a calibration may have found any."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: Annotated[list[float], Field(description="OpenCV's order")]


class CameraSpecs(Given):
    """A camera: exactly one of ``k_cam_px`` and ``lens``."""

    image_width_px: Annotated[Pixels, Field(description="Width of the images it takes, as the sensor lies")]
    image_height_px: Annotated[Pixels, Field(description="Height of the images it takes, as the sensor lies")]
    focus_distance_m: Annotated[
        FocusDistance, Field(description="Metres from the lens to the plane in focus; 100000 stands for infinity")
    ]
    k_cam_px: Annotated[
        BlurPixels | None, Field(description="Blur per unit of relative defocus, at `image_width_px`")
    ] = None
    f_number: Annotated[
        FNumber | None, Field(description="Aperture that `k_cam_px` holds at, to know photographs of another by")
    ] = None
    lens: LensSpecs | None = None
    gamma_px: Annotated[
        float, Field(ge=0, le=1_000, allow_inf_nan=False, description="Blur of a point in perfect focus")
    ] = 0.5
    intrinsics: PinholeIntrinsics | None = None
    description: Annotated[str, Field(max_length=1000), Worded(PLAIN_TEXT, NO_CONTROLS)] | None = None

    def to_draft(self, name: str) -> CameraDraft:
        """The camera under a name, with what it was made from; ``BadRequest`` where the numbers do not fit together."""
        lens = self.lens.to_domain() if self.lens else None
        return CameraDraft(name, self._camera(lens), "lens" if lens else "given", lens, self.description)

    def _camera(self, lens: Lens | None) -> Camera:
        intrinsics = self.intrinsics.to_domain() if self.intrinsics else None
        try:
            return Camera(
                image_width_px=self.image_width_px,
                image_height_px=self.image_height_px,
                focus_distance_m=self.focus_distance_m,
                k_cam_px=self._k_cam_px(lens),
                gamma_px=self.gamma_px,
                focal_length_m=lens.focal_length_m if lens else None,
                f_number=lens.f_number if lens else self.f_number,
                intrinsics=intrinsics,
            )
        except (ValueError, ArithmeticError) as exc:
            raise BadRequest.at(f"These numbers make no camera: {exc}.", "#") from exc

    def _k_cam_px(self, lens: Lens | None) -> float:
        if lens is None and self.k_cam_px is not None:
            return self.k_cam_px
        if lens is None or self.k_cam_px is not None:
            both = "not both" if lens else "one of them is needed"
            raise BadRequest.at(f"Send exactly one of k_cam_px and lens, {both}.", "#/k_cam_px", "#/lens")
        if self.f_number is not None:
            raise BadRequest.at("With lens, f_number is that of the lens: send it there alone.", "#/f_number")
        if lens.focal_length_m >= self.focus_distance_m:
            raise BadRequest.at(
                f"A lens of {lens.focal_length_mm:g} mm cannot focus at {self.focus_distance_m:g} m: "
                "the focal length must be shorter than the focus distance, which counts from the lens' front principal "
                "plane and is f (1 + 1/m) at magnification m.",
                "#/lens/focal_length_mm",
            )
        return lens.k_cam_px(self.focus_distance_m, self.image_width_px)


# goes without saying, but for linters that take what a schema does not name for forbidden
AND_MORE: dict[str, JsonValue] = {"additionalProperties": True}
# what to_draft asks for, in words that what makes clients passes over: of a choice it makes types, or fails
K_CAM_OR_LENS: dict[str, JsonValue] = {
    "if": {"required": ["lens"], "properties": {"lens": {"type": "object"}}, **AND_MORE},
    "then": {"properties": {"k_cam_px": {"type": "null"}, "f_number": {"type": "null"}}, **AND_MORE},
    "else": {"required": ["k_cam_px"], "properties": {"k_cam_px": {"type": "number"}}, **AND_MORE},
}
K_CAM_EXAMPLE: dict[str, JsonValue] = {
    "name": "pixel7-wide",
    "image_width_px": 4080,
    "image_height_px": 3072,
    "focus_distance_m": 2.0,
    "k_cam_px": 1.31,
    "gamma_px": 0.6,
}
LENS_EXAMPLE: dict[str, JsonValue] = {
    "name": "d200",
    "image_width_px": 645,
    "image_height_px": 432,
    "focus_distance_m": 2.0,
    "gamma_px": 0.5,
    "lens": {"focal_length_mm": 35, "f_number": 2.8, "pixel_pitch_um": 6.05, "sensor_width_px": 3872, "k_r": 4.0},
}


class CameraCreate(CameraSpecs):
    """A camera to register."""

    model_config = ConfigDict(json_schema_extra={**K_CAM_OR_LENS, "examples": [LENS_EXAMPLE, K_CAM_EXAMPLE]})

    name: Name

    @classmethod
    def from_record(cls, record: CameraRecord) -> Self:
        """What registers a stored camera anew."""
        camera, lens, known = record.camera, record.draft.lens, record.camera.intrinsics
        inner = asdict(known) | {"distortion": [*known.distortion]} if known else None
        return cls(
            name=record.name,
            image_width_px=camera.image_width_px,
            image_height_px=camera.image_height_px,
            focus_distance_m=camera.focus_distance_m,
            k_cam_px=None if lens else camera.k_cam_px,
            f_number=None if lens else camera.f_number,
            lens=_lens_read(lens),
            gamma_px=camera.gamma_px,
            intrinsics=PinholeIntrinsics.model_validate(inner) if inner else None,
            description=record.draft.description,
        )


class CameraReplace(CameraSpecs):
    """A camera's next revision, whole; what is left out takes its default."""

    model_config = ConfigDict(json_schema_extra={**K_CAM_OR_LENS, "examples": [LENS_EXAMPLE]})

    name: Annotated[Name | None, Field(description="May be left out; a camera cannot be renamed")] = None

    def to_named_draft(self, name: str) -> CameraDraft:
        """The draft for the camera in the URL; ``BadRequest`` where the body names another."""
        if self.name is not None and self.name != name:
            raise BadRequest.at(
                "This is not the name in the URL, and a camera cannot be renamed: send the same name, or none.",
                "#/name",
            )
        return self.to_draft(name)


class LensDraft(BaseModel):
    """Lens specs as far as a photograph tells them."""

    focal_length_mm: Annotated[float | None, Field(description="Real focal length, never the 35-mm equivalent")]
    f_number: float | None
    pixel_pitch_um: float | None
    sensor_width_px: int | None
    k_r: float = K_R_OF_DISC


class CameraDraftRead(BaseModel):
    """A camera to be: fill in what is null, leave out `warnings`, and send it to `POST /cameras`."""

    name: Annotated[Name, Field(description="A proposal")]
    description: str | None
    image_width_px: int
    image_height_px: int
    focus_distance_m: float | None
    gamma_px: Annotated[float, Field(description="The default: no photograph's EXIF tells it")] = 0.5
    lens: LensDraft
    warnings: Annotated[list[str], Field(description="What is missing, and what is no more than a guess")]


class RangeRead(BaseModel):
    """Depths between which 0.25 px of blur error moves the depth by less than 10 %."""

    near: Annotated[float, Field(description="Metres")]
    far: Annotated[float, Field(description="Metres")]


class CameraRead(BaseModel):
    """A stored camera at one revision."""

    name: Name
    description: str | None
    image_width_px: int
    image_height_px: int
    focus_distance_m: float
    k_cam_px: float
    gamma_px: float
    k_r: Annotated[
        float,
        Field(description="Diameter of the circle of confusion over its standard deviation, behind k_cam"),
    ]
    source: Annotated[Source, Field(description="Where k_cam came from")]
    f_number: Annotated[float | None, Field(description="Aperture that k_cam holds at; null where it is not known")]
    lens: LensSpecs | None
    intrinsics: IntrinsicsRead | None
    fx_px: Annotated[float | None, Field(description="From the intrinsics or the lens, else null")]
    range_m: RangeRead
    revision: Annotated[int, Field(description="Grows by one with every change; never used twice under one name")]
    created_at: Annotated[datetime, Field(description="UTC")]
    updated_at: Annotated[datetime, Field(description="UTC")]

    @classmethod
    def from_record(cls, record: CameraRecord) -> Self:
        """The stored camera, with what follows from it."""
        draft = record.draft
        given = {"name": draft.name, "description": draft.description, "lens": _lens_read(draft.lens)}
        stored = {"revision": record.revision, "created_at": record.created_at, "updated_at": record.updated_at}
        return cls.model_validate(_numbers(draft) | given | stored)


class CameraPage(BaseModel):
    """Cameras by name."""

    items: list[CameraRead]
    next_cursor: NextCursor


class RevisionPage(BaseModel):
    """A camera's revisions, the newest first; the times of each are those when it was written."""

    items: list[CameraRead]
    next_cursor: NextCursor


class CurvePoint(BaseModel):
    """What the camera shows of a point at one distance."""

    depth_m: float
    blur_px: Annotated[float, Field(description="Standard deviation of the blur in the image")]
    defocus_px: Annotated[float, Field(description="The part of it that comes from defocus")]
    depth_error_m: Annotated[float, Field(description="How far 0.25 px of blur error moves the depth")]


class PreviewRead(BaseModel):
    """What follows from a camera's numbers; nothing of it is stored."""

    focus_distance_m: float
    k_cam_px: float
    gamma_px: float
    k_r: float
    source: Source
    fx_px: Annotated[float | None, Field(description="From the intrinsics or the lens, else null")]
    range_m: RangeRead
    points: Annotated[
        list[CurvePoint], Field(description="Blur by distance, as `GET /cameras/{name}/curve` has it by default")
    ]

    @classmethod
    def from_draft(cls, draft: CameraDraft, points: list[CurvePoint]) -> Self:
        """The camera of a draft, with what follows from it."""
        return cls.model_validate(_numbers(draft) | {"points": points})


class CurveRead(BaseModel):
    """Blur against distance, at the camera's image size."""

    camera: str
    revision: int
    focus_distance_m: float
    points: list[CurvePoint]


def _numbers(draft: CameraDraft) -> dict[str, object]:
    """A camera's numbers and what follows from them, by their names on the wire."""
    near, far = draft.camera.range_m
    seen = draft.with_focal_length.intrinsics
    told = {"k_r": draft.k_r, "source": draft.source, "fx_px": seen and seen.fx_px}
    return asdict(draft.camera) | told | {"range_m": {"near": near, "far": far}}


def _lens_read(lens: Lens | None) -> LensSpecs | None:
    # what is stored was good when it was: no bound is set to it
    return LensSpecs.model_construct(**asdict(lens)) if lens else None
