"""``POST /photographs/preview``: a photograph as a picture that every browser shows."""

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from service.api.clients import unless_gone
from service.api.dependencies import SettingsDep, SharerDep, WorkerDep
from service.api.problems import responses
from service.api.uploads import REQUEST_BODY, Upload, receive_photograph
from service.errors import BadRequest, Busy, InvalidImage, TooLarge, UnsupportedKind
from service.inference.cancellation import Cancellation
from service.inference.encode import Encoded, encode_photograph
from service.inference.images import ImageLimits, read_photograph

router = APIRouter(prefix="/photographs", tags=["depth"])


@router.post(
    "/preview",
    operation_id="previewPhotograph",
    summary="A photograph of any kind as a JPEG",
    response_class=Response,
    responses={
        200: {
            "description": "The upright photograph, made small",
            "content": {"image/jpeg": {}},
        },
        **responses(TooLarge, UnsupportedKind, BadRequest, InvalidImage, Busy),
    },
    openapi_extra={"requestBody": REQUEST_BODY},
)
async def preview_photograph(
    request: Request,
    settings: SettingsDep,
    worker: WorkerDep,
    sharer: SharerDep,
    longest_px: Annotated[int, Query(ge=16, le=4096, description="Its longer side at most")] = 1600,
) -> Response:
    """What HEIC and raw files show, for browsers that do not read them. Nothing is stored."""
    upload = await receive_photograph(request)
    work = worker.run(sharer, _encoded, upload, longest_px, ImageLimits.of(settings))
    encoded = (await unless_gone(request, work)).value
    return Response(encoded.body, media_type=encoded.media_type)


def _encoded(cancellation: Cancellation, upload: Upload, longest_px: int, limits: ImageLimits) -> Encoded:
    """Decode and encode: all the work of a request, in one thread."""
    photograph = read_photograph(upload.data, upload.media_type, limits)
    cancellation.check()
    return encode_photograph(photograph.rgb, longest_px)
