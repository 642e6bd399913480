"""``POST /calibrate/look``: one photograph of the sheet, and what a calibration would make of it."""

from typing import Annotated

from fastapi import APIRouter, Query, Request
from fastapi.concurrency import run_in_threadpool

from service.api.calibration_schemas import LookRead
from service.api.camera_schemas import Name
from service.api.clients import unless_gone
from service.api.dependencies import CamerasDep, SettingsDep, SharerDep, WorkerDep
from service.api.problems import responses
from service.api.target import GridDep
from service.api.uploads import REQUEST_BODY, receive_photograph
from service.calibration.target import CircleGrid
from service.errors import BadRequest, Busy, InvalidImage, NotFound, TooLarge, UnsupportedKind
from service.inference.cancellation import Cancellation
from service.inference.frame import stored_intrinsics
from service.inference.images import ImageLimits, read_stored_frame
from service.optics.camera import Camera

router = APIRouter(prefix="/calibrate", tags=["calibration"])


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
    work = worker.run(sharer, _seen, upload.data, grid, known, ImageLimits.of(settings))
    return (await unless_gone(request, work)).value


def _seen(
    cancellation: Cancellation, data: bytes, grid: CircleGrid, camera: Camera | None, limits: ImageLimits
) -> LookRead:
    """Decode and look: all the work of a request, in one thread."""
    from service.calibration.look import look  # it loads SciPy

    frame = read_stored_frame(data, limits)
    cancellation.check()
    intrinsics, source = stored_intrinsics(frame, camera)
    seen = look(frame.rgb, grid, intrinsics, cancellation.check)
    return LookRead.from_look(seen, frame.orientation, source if seen.distance_m else None)
