"""``POST /depth``: one photograph in, metres out."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from fastapi.concurrency import run_in_threadpool

from service.api.clients import unless_gone
from service.api.dependencies import CamerasDep, EstimatorDep, SettingsDep, WorkerDep
from service.api.depth_schemas import DepthQuery, DepthRead, PointRead, SpreadRead
from service.api.negotiation import choose_format
from service.api.problems import responses
from service.api.uploads import REQUEST_BODY, Upload, receive_photograph
from service.errors import (
    BadRequest,
    Busy,
    FieldProblem,
    ImageSizeMismatch,
    InvalidImage,
    NotAcceptable,
    NotFound,
    TooLarge,
    UnsupportedKind,
)
from service.inference.cancellation import Cancellation
from service.inference.depth_map import DepthMap
from service.inference.encode import ENCODERS, MEDIA_TYPES, Encoded, pixel_at, read_point, spread_of
from service.inference.estimator import Estimator
from service.inference.frame import camera_of, other_lens
from service.inference.images import ImageLimits, read_photograph
from service.inference.pair import Stopwatch
from service.inference.part import Part
from service.optics.camera import Camera
from service.storage.cameras import CameraRecord
from service.tracing import STAGES_KEY

JSON = "json"
FORMAT_TYPES = {**MEDIA_TYPES, JSON: "application/json"}
STAGES = ("decode", "wait", "blur", "correct", "depth", "encode")


@dataclass(frozen=True, slots=True)
class Order:
    """Everything the work needs, so that it touches neither request nor database."""

    upload: Upload
    record: CameraRecord
    camera: Camera
    query: DepthQuery
    format: str
    limits: ImageLimits
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Answer:
    """The encoded map, the camera it is by, everything worth a warning, and the time of each stage in milliseconds."""

    encoded: Encoded
    camera: Camera
    warnings: tuple[str, ...]
    timings_ms: Mapping[str, float]


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
            "content": {
                media_type: {"schema": {"type": "string", "format": "binary"}} for media_type in MEDIA_TYPES.values()
            },
            "headers": {
                name: {"description": meaning, "schema": {"type": "string"}}
                for name, meaning in {
                    "Camind-Camera": "The camera's name",
                    "Camind-Camera-Revision": "The camera's revision that was used",
                    "Camind-Model": "The model's name",
                    "Camind-Focus-Distance-M": "The focus distance used, in metres",
                    "Camind-Depth-Scale-M": "Metres per unit of the map: 0.001 for png, else 1",
                    "Camind-Warnings": "What to know about this answer, separated by semicolons",
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
) -> Response:
    """Depth along the optical axis for every pixel, from the blur of one photograph and its camera.

    The photograph must be the camera's whole frame, at any size; a part of the map alone is `roi`. Without an answer a
    pixel is NaN, in png 0.
    """
    chosen = choose_format(query.format, request.headers.get("accept"), FORMAT_TYPES)
    upload = await receive_photograph(request, settings.max_image_bytes)
    record = await run_in_threadpool(cameras.get, query.camera)
    camera, warnings = _focused(record.draft.with_focal_length, query.focus_distance_m)
    limits = ImageLimits.of(settings)
    order = Order(upload, record, camera, query, chosen, limits, warnings)
    outcome = await unless_gone(request, worker.run(fulfil, order, estimator))
    answer = outcome.value
    timings_ms = {**answer.timings_ms, "wait": outcome.wait_ms}
    request.app.state.metrics.time_stages(timings_ms)
    request.scope[STAGES_KEY] = timings_ms
    return Response(
        answer.encoded.body,
        media_type=answer.encoded.media_type,
        headers={
            "Camind-Camera": record.name,
            "Camind-Camera-Revision": str(record.revision),
            "Camind-Model": estimator.manifest.name,
            "Camind-Focus-Distance-M": f"{answer.camera.focus_distance_m:.6g}",
            "Camind-Depth-Scale-M": f"{answer.encoded.depth_scale_m:g}",
            "Camind-Warnings": _header_safe("; ".join(answer.warnings)),
            "Server-Timing": ", ".join(f"{stage};dur={timings_ms[stage]:.1f}" for stage in STAGES),
            "Vary": "Accept",
        },
    )


def fulfil(cancellation: Cancellation, order: Order, estimator: Estimator) -> Answer:
    """Decode, estimate and encode: all the work of a request, in one thread."""
    stopwatch = Stopwatch()
    with stopwatch.stage("decode"):
        photograph = read_photograph(order.upload.data, order.upload.media_type, order.limits)
    camera, resized = camera_of(photograph, order.camera)
    lens = order.record.draft.lens
    taken = other_lens(photograph.shot, lens) if lens else ()
    part = order.query.part or Part(0, 0, photograph.width_px, photograph.height_px)
    part.require_within(photograph.width_px, photograph.height_px)
    for u, v in order.query.points:
        pixel_at(u, v, part)
    known = order.query.known_depths
    for point in known:
        pixel_at(point.u, point.v, Part(0, 0, photograph.width_px, photograph.height_px), "known")
    depth_map = estimator.estimate(photograph.rgb, camera, order.query.side, cancellation, order.query.part, known)
    stopwatch.add(depth_map.timings_ms)
    warnings = (*order.warnings, *photograph.warnings, *taken, *resized, *depth_map.warnings)
    with stopwatch.stage("encode"):
        if order.format == JSON:
            encoded = _encode_json(depth_map, order, part, estimator.manifest.name, warnings)
        else:
            encoded = ENCODERS[order.format](depth_map, part.of(photograph.rgb))
    return Answer(encoded, depth_map.camera, (*warnings, *encoded.warnings), stopwatch.elapsed_ms)


def _encode_json(depth_map: DepthMap, order: Order, part: Part, model: str, warnings: tuple[str, ...]) -> Encoded:
    read = DepthRead(
        camera=order.record.name,
        revision=order.record.revision,
        model=model,
        width_px=depth_map.width_px,
        height_px=depth_map.height_px,
        depth_m=SpreadRead.model_validate(spread_of(depth_map)),
        valid_fraction=depth_map.valid_fraction,
        points=[PointRead.model_validate(read_point(depth_map, u, v, part)) for u, v in order.query.points],
        warnings=list(warnings),
    )
    return Encoded(read.model_dump_json().encode(), FORMAT_TYPES[JSON])


def _focused(camera: Camera, focus_distance_m: float | None) -> tuple[Camera, tuple[str, ...]]:
    """The camera at this shot's focus distance, with a warning where that is not exact."""
    if focus_distance_m is None or focus_distance_m == camera.focus_distance_m:
        return camera, ()
    try:
        focused = camera.focused_at(focus_distance_m)
    except ValueError as exc:
        detail = f"The camera cannot focus at {focus_distance_m:g} m: {exc}."
        raise BadRequest(detail, errors=(FieldProblem("focus_distance_m", detail),)) from exc
    if camera.focal_length_m is None:
        return focused, ("The lens' focal length is unknown and was taken as far below the focus distance.",)
    return focused, ()


def _header_safe(text: str) -> str:
    return "".join(letter if " " <= letter <= "~" else "?" for letter in text)
