"""``/cameras``: preview, register, read, replace, delete, list, and a camera's revisions and blur curve."""

import re
from dataclasses import replace
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Query, Request, Response
from fastapi.concurrency import run_in_threadpool

from service.api.camera_schemas import (
    CameraCreate,
    CameraDraftRead,
    CameraPage,
    CameraRead,
    CameraReplace,
    CurvePoint,
    CurveRead,
    PreviewRead,
    RevisionPage,
)
from service.api.cursors import Cursor, Limit, cursor_after, name_of
from service.api.dependencies import CamerasDep, IdempotencyKey, require_json
from service.api.problems import STORE_ERRORS, WRITE_ERRORS, responses
from service.api.uploads import REQUEST_BODY, receive_photograph
from service.errors import (
    BadRequest,
    Busy,
    Conflict,
    InvalidImage,
    KeyReused,
    NotFound,
    PreconditionFailed,
    TooLarge,
    UnsupportedKind,
)
from service.inference.drafting import Draft, draft_camera
from service.inference.exif import read_exif
from service.inference.headers import read_header
from service.inference.making import noted_making
from service.optics import thin_lens
from service.optics.camera import RANGE_BLUR_ERROR_PX, Camera
from service.storage.cameras import CameraRecord
from service.storage.idempotency import once_of

BODY_ERRORS = (BadRequest, UnsupportedKind)
ETAG = {"ETag": {"description": "The revision, for If-Match", "schema": {"type": "string"}}}
LOCATION = {"Location": {"description": "The camera's path", "schema": {"type": "string"}}}
# another owner's camera, or another database's, has the same path and the same revision; and what is compressed on its
# way has a weak tag, which If-Match does not take
UNCACHED = {"Cache-Control": "no-store, no-transform", "Vary": "Authorization"}
CURVE_SPAN = 5.0
CURVE_POINTS = 101
REVISION_PATTERN = r"[1-9][0-9]{0,8}"

router = APIRouter(prefix="/cameras", tags=["cameras"])

IfMatch = Annotated[
    str | None, Header(description="ETag of the revision that is to be changed; another one answers 412")
]
IfNoneMatch = Annotated[str | None, Header(description="ETag of a revision that is at hand; the same answers 304")]
Depth = Annotated[float | None, Query(ge=0.001, le=100_000, allow_inf_nan=False, description="Metres")]


@router.post(
    "",
    operation_id="createCamera",
    status_code=201,
    summary="Register a camera",
    dependencies=[Depends(require_json)],
    responses={
        201: {"headers": {**LOCATION, **ETAG}},
        **responses(Conflict, *BODY_ERRORS, KeyReused, *WRITE_ERRORS),
    },
)
def create_camera(
    body: CameraCreate, cameras: CamerasDep, response: Response, idempotency_key: IdempotencyKey = None
) -> CameraRead:
    """Register a camera from its k_cam or from its lens specs; no training is needed."""
    # without defaults: a field that a later version has makes no other request of one whose answer the upgrade lost
    once = once_of(idempotency_key, [b"POST /cameras", body.model_dump_json(exclude_defaults=True).encode()])
    record = cameras.add(body.to_draft(body.name), once)
    response.headers["Location"] = f"/cameras/{record.name}"
    return _answer(record, response)


@router.get(
    "",
    operation_id="listCameras",
    summary="List cameras by name",
    responses=responses(BadRequest, *STORE_ERRORS),
)
def list_cameras(
    cameras: CamerasDep,
    limit: Limit = 50,
    cursor: Cursor = None,
) -> CameraPage:
    """Cameras at their current revisions, a page at a time."""
    records, has_more = cameras.page(limit, name_of(cursor))
    return CameraPage(
        items=[CameraRead.from_record(record) for record in records],
        next_cursor=cursor_after(records[-1].name) if has_more else None,
    )


@router.post(
    "/from-photo",
    operation_id="draftCamera",
    summary="Draft a camera from a photograph",
    responses=responses(BadRequest, InvalidImage, TooLarge, UnsupportedKind, Busy),
    openapi_extra={"requestBody": REQUEST_BODY},
)
async def draft_camera_from_photo(request: Request) -> CameraDraftRead:
    """What the photograph's EXIF tells of the camera that took it; nothing is stored, of either."""
    upload = await receive_photograph(request)
    return CameraDraftRead.model_validate(await run_in_threadpool(_drafted, upload.data), from_attributes=True)


@router.post(
    "/preview",
    operation_id="previewCamera",
    summary="See what a camera's numbers come to",
    dependencies=[Depends(require_json)],
    responses=responses(*BODY_ERRORS),
)
def preview_camera(body: CameraReplace) -> PreviewRead:
    """k_cam, range and blur curve of a camera as `POST /cameras` takes it, name or not; nothing is stored."""
    draft = body.to_draft("preview")
    middle_m = draft.camera.middle_m
    points = _curve(draft.camera, middle_m / CURVE_SPAN, middle_m * CURVE_SPAN, CURVE_POINTS)
    return PreviewRead.from_draft(draft, points)


@router.get(
    "/{name}",
    operation_id="readCamera",
    summary="Read a camera",
    response_model=CameraRead,
    responses={
        200: {"headers": ETAG},
        304: {"description": "The revision of If-None-Match is the current one", "headers": ETAG},
        **responses(NotFound, *STORE_ERRORS),
    },
)
def read_camera(
    name: str, cameras: CamerasDep, response: Response, if_none_match: IfNoneMatch = None
) -> CameraRead | Response:
    """The camera at its current revision."""
    record = cameras.get(name)
    answer = _answer(record, response)
    if _is_at_hand(record.revision, if_none_match):
        return Response(status_code=304, headers=response.headers)
    return answer


@router.put(
    "/{name}",
    operation_id="replaceCamera",
    summary="Give a camera a new revision",
    dependencies=[Depends(require_json)],
    responses={
        200: {"headers": ETAG},
        **responses(NotFound, PreconditionFailed, *BODY_ERRORS, *WRITE_ERRORS),
    },
)
def replace_camera(
    name: str, body: CameraReplace, cameras: CamerasDep, response: Response, if_match: IfMatch = None
) -> CameraRead:
    """Replace the camera whole; the revision before stays in the database."""
    record = cameras.replace(body.to_named_draft(name), _revisions(if_match))
    return _answer(record, response)


@router.delete(
    "/{name}",
    operation_id="deleteCamera",
    status_code=204,
    response_class=Response,
    summary="Delete a camera",
    responses=responses(NotFound, PreconditionFailed, *WRITE_ERRORS),
)
def delete_camera(name: str, cameras: CamerasDep, if_match: IfMatch = None) -> None:
    """Free the name. A camera registered under it later goes on counting revisions."""
    cameras.delete(name, _revisions(if_match))


@router.get(
    "/{name}/revisions",
    operation_id="listCameraRevisions",
    summary="List a camera's revisions, the newest first",
    responses=responses(NotFound, BadRequest, *STORE_ERRORS),
)
def list_revisions(
    name: str,
    cameras: CamerasDep,
    limit: Limit = 50,
    cursor: Cursor = None,
) -> RevisionPage:
    """What the camera was at every revision, those of a deleted camera of this name among them."""
    before = name_of(cursor, REVISION_PATTERN)
    records, has_more = cameras.revisions(name, limit, int(before) if before else None)
    return RevisionPage(
        items=[CameraRead.from_record(record) for record in records],
        next_cursor=cursor_after(records[-1].revision) if has_more else None,
    )


@router.get(
    "/{name}/curve",
    operation_id="readCameraCurve",
    summary="Blur against distance",
    responses=responses(NotFound, BadRequest, *STORE_ERRORS),
)
def read_curve(
    name: str,
    cameras: CamerasDep,
    near_m: Depth = None,
    far_m: Depth = None,
    points: Annotated[int, Query(ge=2, le=2_000, description="Evenly spaced in distance")] = CURVE_POINTS,
) -> CurveRead:
    """The blur the camera shows by distance, by default from a fifth to five times its focus distance.

    Of one focused at 50 m or farther, which is all but infinity, from a fifth to five times where its range ends.
    """
    record = cameras.get(name)
    middle_m = record.camera.middle_m
    near = near_m if near_m is not None else min(middle_m, far_m or middle_m) / CURVE_SPAN
    far = far_m if far_m is not None else max(middle_m, near_m or middle_m) * CURVE_SPAN
    if near >= far:
        raise BadRequest.at("near_m must be smaller than far_m.", "near_m", "far_m")
    return CurveRead(
        camera=record.name,
        revision=record.revision,
        focus_distance_m=record.camera.focus_distance_m,
        points=_curve(record.camera, near, far, points),
    )


def _drafted(data: bytes) -> Draft:
    header = read_header(data)
    draft = draft_camera(read_exif(header.exif), header.width_px, header.height_px)
    return replace(draft, warnings=(*draft.warnings, *noted_making(data, header)))


def _answer(record: CameraRecord, response: Response) -> CameraRead:
    response.headers.update({**UNCACHED, "ETag": f'"{record.revision}"'})
    return CameraRead.from_record(record)


def _revisions(if_match: str | None) -> list[int] | None:
    """The revisions that If-Match allows, ``None`` for any; weak and foreign tags match none (RFC 9110)."""
    if if_match is None or if_match.strip() == "*":
        return None
    return [int(number) for number in re.findall(r'(?<!W/)"(\d{1,9})"', if_match)]


def _is_at_hand(revision: int, if_none_match: str | None) -> bool:
    """Whether If-None-Match has the revision; here a weak tag is as good (RFC 9110)."""
    tags = [tag.strip().removeprefix("W/") for tag in (if_none_match or "").split(",")]
    return "*" in tags or f'"{revision}"' in tags


def _curve(camera: Camera, near_m: float, far_m: float, points: int) -> list[CurvePoint]:
    focus_m, k_cam_px = camera.focus_distance_m, camera.k_cam_px
    depths = (near_m + (far_m - near_m) * step / (points - 1) for step in range(points))
    return [
        CurvePoint(
            depth_m=depth_m,
            blur_px=camera.blur_px(depth_m),
            defocus_px=thin_lens.defocus_at_depth(depth_m, focus_m, k_cam_px),
            depth_error_m=thin_lens.depth_error(depth_m, focus_m, k_cam_px, RANGE_BLUR_ERROR_PX),
        )
        for depth_m in depths
    ]
