"""``POST /depth``: one photograph in, metres out."""

from collections.abc import Sequence
from itertools import accumulate
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from fastapi.concurrency import run_in_threadpool

from service.api.clients import unless_gone
from service.api.dependencies import CamerasDep, EstimatorDep, SettingsDep, SharerDep, WorkerDep
from service.api.depth_schemas import DepthQuery, DepthRead
from service.api.negotiation import choose_format
from service.api.orders import FORMAT_TYPES, Order, fulfil
from service.api.problems import responses
from service.api.uploads import REQUEST_BODY, receive_photograph
from service.errors import (
    BadRequest,
    Busy,
    ImageSizeMismatch,
    InvalidImage,
    NotAcceptable,
    NotFound,
    TooLarge,
    UnsupportedKind,
)
from service.inference.encode import MEDIA_TYPES
from service.inference.images import ImageLimits
from service.tracing import STAGES_KEY

MOST_LETTERS = 2_000  # of warnings in a header: nginx takes 4 kB for all of them, or answers 502
STAGES = ("decode", "wait", "blur", "correct", "depth", "encode")

router = APIRouter(tags=["depth"])


@router.post(
    "/depth",
    operation_id="estimateDepth",
    summary="Depth in metres from one photograph",
    response_class=Response,
    responses={
        200: {
            "model": DepthRead,
            "description": "The depth map, of the size of the upright photograph or of the part asked for",
            "content": {media_type: {} for media_type in MEDIA_TYPES.values()},
            "headers": {
                name: {"description": meaning, "schema": {"type": "string"}}
                for name, meaning in {
                    "Camind-Camera": "The camera's name",
                    "Camind-Camera-Revision": "The camera's revision that was used",
                    "Camind-Model": "The model's name",
                    "Camind-Focus-Distance-M": "The focus distance used, in metres",
                    "Camind-Depth-Scale-M": "Metres per unit of the map: 0.001 for png, else 1",
                    "Camind-Warnings": "What to know about this answer, separated by semicolons; json has all of many",
                    "Server-Timing": f"Milliseconds of {', '.join(STAGES)}",
                }.items()
            },
        },
        **responses(
            NotFound,
            NotAcceptable,
            TooLarge,
            UnsupportedKind,
            BadRequest,
            InvalidImage,
            ImageSizeMismatch,
            Busy,
        ),
    },
    openapi_extra={"requestBody": REQUEST_BODY},
)
async def estimate_depth(
    request: Request,
    query: Annotated[DepthQuery, Query()],
    settings: SettingsDep,
    cameras: CamerasDep,
    estimator: EstimatorDep,
    worker: WorkerDep,
    sharer: SharerDep,
) -> Response:
    """Depth along the optical axis for every pixel, from the blur of one photograph and its camera.

    The photograph must be the camera's whole frame, at any size; a part of the map alone is `roi`. Without an answer a
    pixel is NaN, in png 0.
    """
    chosen = choose_format(query.format, ", ".join(request.headers.getlist("accept")), FORMAT_TYPES)
    record = await run_in_threadpool(cameras.get, query.camera)
    upload = await receive_photograph(request)
    order = Order.of(upload, record, query, (chosen,), ImageLimits.of(settings))
    outcome = await unless_gone(request, worker.run(sharer, fulfil, order, estimator))
    answer = outcome.value
    (encoded,) = answer.encoded
    timings_ms = {**answer.timings_ms, "wait": outcome.wait_ms}
    request.app.state.metrics.time_stages(timings_ms)
    request.scope[STAGES_KEY] = timings_ms
    return Response(
        encoded.body,
        media_type=encoded.media_type,
        headers={
            "Camind-Camera": record.name,
            "Camind-Camera-Revision": str(record.revision),
            "Camind-Model": estimator.manifest.name,
            "Camind-Focus-Distance-M": f"{answer.camera.focus_distance_m:.6g}",
            "Camind-Depth-Scale-M": f"{encoded.depth_scale_m:g}",
            "Camind-Warnings": _in_a_header(answer.warnings),
            "Server-Timing": ", ".join(f"{stage};dur={timings_ms[stage]:.1f}" for stage in STAGES),
            "Vary": "Accept",
        },
    )


def _in_a_header(warnings: Sequence[str]) -> str:
    """As many as there is room for, in the letters that a header may have, and what divides them within none."""
    warnings = [warning.replace(";", ",") for warning in warnings]
    ends = accumulate(len(warning) + len("; ") for warning in warnings)
    told = [warning for warning, end in zip(warnings, ends, strict=True) if end <= MOST_LETTERS]
    more = len(warnings) - len(told)
    text = "; ".join([*told, f"and {more} more, which format=json has"] if more else told)
    return "".join(letter if " " <= letter <= "~" else "?" for letter in text)
