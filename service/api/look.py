"""``POST /calibrate/look``: one photograph of the sheet, and what a calibration would make of it."""

from dataclasses import dataclass
from typing import Annotated

from fastapi import APIRouter, Query, Request
from fastapi.concurrency import run_in_threadpool

from service.api.calibration_schemas import FocalLengthFrom, LookRead
from service.api.clients import unless_gone
from service.api.dependencies import CamerasDep, SettingsDep, SharerDep, WorkerDep
from service.api.problems import responses
from service.api.schemas import Name
from service.api.target import GridDep
from service.api.uploads import REQUEST_BODY, receive_photograph
from service.calibration.look import look
from service.calibration.target import CircleGrid
from service.errors import BadRequest, Busy, InvalidImage, NotFound, TooLarge, UnsupportedKind
from service.inference.cancellation import Cancellation
from service.inference.drafting import draft_camera
from service.inference.frame import stored_camera_of
from service.inference.images import ImageLimits, StoredFrame, read_stored_frame
from service.optics.camera import Camera, Intrinsics, Lens

router = APIRouter(prefix="/calibrate", tags=["calibration"])


@dataclass(frozen=True, slots=True)
class Order:
    """Everything the work needs, so that it touches neither request nor database."""

    data: bytes
    grid: CircleGrid
    camera: Camera | None
    limits: ImageLimits


@router.post(
    "/look",
    operation_id="lookAtPhotograph",
    summary="Look at one photograph of the sheet",
    responses=responses(NotFound, TooLarge, UnsupportedKind, BadRequest, InvalidImage, Busy),
    openapi_extra={"requestBody": REQUEST_BODY},
)
async def look_at_photograph(
    request: Request,
    grid: GridDep,
    settings: SettingsDep,
    cameras: CamerasDep,
    worker: WorkerDep,
    sharer: SharerDep,
    camera: Annotated[Name | None, Query(description="Its focal length gives distance and tilt")] = None,
) -> LookRead:
    """Where the circles are, how blurred, how far away and how exposed. Nothing is stored.

    Distance and tilt need a focal length: that of the camera if it is given and known, else that of the EXIF.
    """
    known = (await run_in_threadpool(cameras.get, camera)).draft.with_focal_length if camera else None
    upload = await receive_photograph(request)
    order = Order(upload.data, grid, known, ImageLimits.of(settings))
    return (await unless_gone(request, worker.run(sharer, fulfil, order))).value


def fulfil(cancellation: Cancellation, order: Order) -> LookRead:
    """Decode and look: all the work of a request, in one thread."""
    frame = read_stored_frame(order.data, order.limits)
    cancellation.check()
    intrinsics, source = _intrinsics(order.camera, frame)
    seen = look(frame.rgb, order.grid, intrinsics, cancellation.check)
    return LookRead.from_look(seen, frame.orientation, source if seen.distance_m else None)


def _intrinsics(of: Camera | None, frame: StoredFrame) -> tuple[Intrinsics | None, FocalLengthFrom | None]:
    """Those of the camera at the stored frame's size, else what the EXIF tells of the lens."""
    height_px, width_px = frame.rgb.shape[:2]
    camera = of and stored_camera_of(of, width_px, height_px, frame.orientation)
    if camera and camera.intrinsics:
        return camera.intrinsics, "camera"
    guess = draft_camera(frame.exif, width_px, height_px).lens
    if guess.focal_length_mm is None or guess.pixel_pitch_um is None:
        return None, None
    lens = Lens(guess.focal_length_mm, 1.0, guess.pixel_pitch_um, guess.sensor_width_px or width_px)
    return Intrinsics.centred(lens.fx_px(width_px), width_px, height_px), "exif"
