"""A photograph in, its depth encoded: the work of ``POST /depth`` and of ``camind depth``, all of it in one thread."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

from service.api.depth_schemas import DepthQuery, DepthRead, PointRead, SpreadRead
from service.api.uploads import Upload
from service.errors import BadRequest
from service.inference.cancellation import Cancellation
from service.inference.depth_map import DepthMap
from service.inference.encode import ENCODERS, MAPS, MEDIA_TYPES, Beside, Encoded
from service.inference.estimator import Estimator
from service.inference.exif import Exif
from service.inference.figures import pixel_at, read_point, spread_of
from service.inference.frame import (
    camera_of,
    maybe_another_part,
    maybe_of_another_size,
    maybe_seen_otherwise,
    maybe_wrong_specs,
    taken_otherwise,
)
from service.inference.images import ImageLimits, read_photograph
from service.inference.pair import Stopwatch
from service.inference.part import Part
from service.optics.camera import Camera
from service.storage.cameras import CameraRecord

JSON = "json"
PROJECTED = frozenset({"npz", "ply"})  # what holds places across the picture
FORMAT_TYPES = {**MEDIA_TYPES, JSON: "application/json"}


@dataclass(frozen=True, slots=True)
class Order:
    """Everything the work needs, so that it touches neither request nor database."""

    upload: Upload
    record: CameraRecord
    camera: Camera
    query: DepthQuery
    formats: Sequence[str]
    limits: ImageLimits
    warnings: tuple[str, ...]

    @classmethod
    def of(
        cls, upload: Upload, record: CameraRecord, query: DepthQuery, formats: Sequence[str], limits: ImageLimits
    ) -> Self:
        """By the camera as this shot was focused; raises ``BadRequest`` where it cannot be focused so."""
        camera, warnings = _focused(record.draft.with_focal_length, query.focus_distance_m)
        return cls(upload, record, camera, query, formats, limits, warnings)


@dataclass(frozen=True, slots=True)
class Answer:
    """The map in the forms that were ordered, the camera it is by, what is worth a warning, milliseconds by stage."""

    encoded: tuple[Encoded, ...]
    camera: Camera
    warnings: tuple[str, ...]
    timings_ms: Mapping[str, float]


def fulfil(cancellation: Cancellation, order: Order, estimator: Estimator) -> Answer:
    """Decode, estimate and encode.

    Raises ``InvalidImage``, ``UnsupportedKind``, ``TooLarge``, ``ImageSizeMismatch``, ``BadRequest`` for what no such
    photograph can be asked, and ``Cancelled``.
    """
    stopwatch = Stopwatch()
    with stopwatch.stage("decode"):
        photograph = read_photograph(order.upload.data, order.upload.media_type, order.limits)
    camera, resized = camera_of(photograph, order.camera)
    whole = Part(0, 0, photograph.width_px, photograph.height_px)
    part = order.query.part or whole
    part.require_within(photograph.width_px, photograph.height_px)
    for u, v in order.query.points:
        pixel_at(u, v, part)
    known = order.query.known_depths
    for point in known:
        pixel_at(point.u, point.v, whole, "known")
    doubts = tuple(_doubts(order, photograph.exif, camera))
    depth_map = estimator.estimate(
        photograph.rgb, camera, order.query.side, cancellation, order.query.part, known, photograph.hidden
    )
    stopwatch.add(depth_map.timings_ms)
    warnings = (*order.warnings, *photograph.warnings, *doubts, *resized, *depth_map.warnings)
    origin = _origin_of(order, whole, estimator.manifest.name, depth_map.camera, warnings)
    beside = Beside(part.of(photograph.rgb), order.query.maps or MAPS, origin)
    longest_px = order.query.longest_px
    with stopwatch.stage("encode"):
        shrunk = depth_map if longest_px is None else depth_map.shrunk(longest_px)
        encoded = tuple(
            _as_json(depth_map, order, part, estimator.manifest.name, warnings)
            if wanted == JSON
            else ENCODERS[wanted](shrunk, beside)
            for wanted in order.formats
        )
    lost = (words for one in encoded for words in one.warnings)
    return Answer(encoded, depth_map.camera, (*warnings, *lost), stopwatch.elapsed_ms)


def _doubts(order: Order, exif: Exif, camera: Camera) -> Iterator[str]:
    """What speaks against the camera that a photograph is said to be by, before any blur is looked at."""
    registered, query = order.record.camera, order.query
    is_refocused, is_found = query.focus_distance_m is not None, bool(query.known)
    yield from taken_otherwise(exif, camera, is_refocused=is_refocused, is_found=is_found)
    yield from maybe_of_another_size(registered)
    yield from maybe_wrong_specs(order.record.draft.lens, registered)
    yield from maybe_another_part(exif, camera)
    if not PROJECTED.isdisjoint(order.formats):
        known_at_m = registered.focus_distance_m if registered.intrinsics else None
        yield from maybe_seen_otherwise(camera, known_at_m)


def _as_json(depth_map: DepthMap, order: Order, part: Part, model: str, warnings: tuple[str, ...]) -> Encoded:
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


def _origin_of(order: Order, whole: Part, model: str, used: Camera, warnings: Sequence[str]) -> dict[str, object]:
    """What makes an answer what it is, but for the photograph, whose size it has; ``used`` is the camera it is by."""
    return {
        "camera": order.record.name,
        "revision": order.record.revision,
        "model": model,
        "image_width_px": whole.width_px,
        "image_height_px": whole.height_px,
        "side": order.query.side,
        "focus_distance_m": used.focus_distance_m,
        "roi": order.query.roi,
        "known": order.query.known,
        "warnings": warnings,
    }


def _focused(camera: Camera, focus_distance_m: float | None) -> tuple[Camera, tuple[str, ...]]:
    """The camera at this shot's focus distance, with a warning where that is not exact."""
    if focus_distance_m is None or focus_distance_m == camera.focus_distance_m:
        return camera, ()
    try:
        focused = camera.focused_at(focus_distance_m)
    except ValueError as exc:
        raise BadRequest.at(f"The camera cannot focus at {focus_distance_m:g} m: {exc}.", "focus_distance_m") from exc
    if camera.focal_length_m is None:
        return focused, ("the lens' focal length is unknown and was taken as far below the focus distance",)
    return focused, ()
