"""What the service counts about itself, in a registry of its own, and ``GET /metrics``."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version

from fastapi import APIRouter, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.core import GaugeMetricFamily, InfoMetricFamily, Metric
from prometheus_client.process_collector import ProcessCollector
from prometheus_client.registry import Collector

from service.api.problems import responses
from service.errors import CamindError, known_codes
from service.inference.worker import Worker
from service.storage.calibrations import LIVE, Calibrations

METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
UNMATCHED = "unmatched"
DURATION_BUCKETS_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)


@dataclass(frozen=True, slots=True)
class Parts(Collector):
    """The parts of a started service, which are asked how things stand at each scrape."""

    model: str
    worker: Worker
    calibrations: Calibrations
    spool: str
    calibration_queue_size: int

    def collect(self) -> Iterator[Metric]:
        worker = self.worker
        yield InfoMetricFamily("camind_build", "The version that runs", value={"version": version("camind")})
        yield InfoMetricFamily("camind_model", "The model that answers", value={"name": self.model})
        for name, meaning, value in (
            ("camind_depth_in_flight", "Photographs being worked on or waiting", worker.in_flight),
            ("camind_depth_slots", "Photographs that may be worked on at a time", worker.slots),
            ("camind_depth_slots_in_use", "Photographs being worked on", worker.slots_in_use),
            ("camind_depth_queue_size", "Photographs that may wait for a slot", worker.queue_size),
            ("camind_depth_queue_depth", "Photographs waiting for a slot", worker.queue_depth),
            ("camind_calibration_queue_size", "Calibrations that may wait", self.calibration_queue_size),
        ):
            yield GaugeMetricFamily(name, meaning, value)
        # a database that does not answer hides no other figure
        with suppress(CamindError):
            counts = self.calibrations.live_counts(self.spool)
            family = GaugeMetricFamily("camind_calibrations", "Calibrations by state", labels=("state",))
            for state in LIVE:
                family.add_metric((state,), counts[state])
            yield family


class Metrics:
    """Counters of one app; labels are path templates, known methods and problems' codes, so their number is bounded."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self._parts: Parts | None = None
        ProcessCollector(registry=self.registry)
        self._requests = Counter(
            "camind_requests", "Requests answered", ("method", "path", "status"), registry=self.registry
        )
        self._duration_s = Histogram(
            "camind_request_duration_seconds",
            "Time from a request's headers to the end of its answer",
            ("method", "path"),
            buckets=DURATION_BUCKETS_S,
            registry=self.registry,
        )
        self._stage_s = Histogram(
            "camind_depth_stage_seconds",
            "Time of each stage of a depth request",
            ("stage",),
            buckets=DURATION_BUCKETS_S,
            registry=self.registry,
        )
        self._queue_wait_s = Histogram(
            "camind_depth_queue_wait_seconds",
            "Time a photograph waited for a slot",
            buckets=DURATION_BUCKETS_S,
            registry=self.registry,
        )
        self._problems = Counter(
            "camind_problems",
            "Answers that refuse and defects that end a calibration, by code",
            ("code",),
            registry=self.registry,
        )
        for code in sorted(known_codes()):
            self._problems.labels(code)  # a series that began at 1 would hide the first one from increase()
        self.in_progress = Gauge("camind_requests_in_progress", "Requests being answered", registry=self.registry)

    def watch(self, parts: Parts | None) -> None:
        """Ask these parts from now on, instead of those before."""
        if self._parts is not None:
            self.registry.unregister(self._parts)
        if parts is not None:
            self.registry.register(parts)
        self._parts = parts

    def count(self, method: str, path_template: str | None, status: int, duration_s: float) -> None:
        """One answered request; a path that no route has counts as ``unmatched``."""
        method = method if method in METHODS else "other"
        path = path_template or UNMATCHED
        self._requests.labels(method, path, str(status)).inc()
        self._duration_s.labels(method, path).observe(duration_s)

    def count_problem(self, code: str) -> None:
        """One answer, or a calibration's end, that was a problem, by the code of its class."""
        self._problems.labels(code).inc()

    def time_wait(self, wait_s: float) -> None:
        """One photograph that got its slot."""
        self._queue_wait_s.observe(wait_s)

    def time_stages(self, timings_ms: Mapping[str, float]) -> None:
        """One answered depth request, milliseconds by stage."""
        for stage, elapsed_ms in timings_ms.items():
            self._stage_s.labels(stage).observe(elapsed_ms / 1e3)


router = APIRouter(tags=["service"])


@router.get(
    "/metrics",
    operation_id="readMetrics",
    summary="Counters for Prometheus",
    response_class=Response,
    responses={
        200: {
            "description": "Prometheus text format",
            "content": {"text/plain": {"schema": {"type": "string"}}},
        },
        **responses(),
    },
)
def read_metrics(request: Request) -> Response:
    """Requests and problems, slots and queues, the time of each stage, and the process's memory, files and time."""
    metrics: Metrics = request.app.state.metrics
    return Response(generate_latest(metrics.registry), media_type=CONTENT_TYPE_LATEST)
