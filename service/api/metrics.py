"""What the service counts about itself, in a registry of its own, and ``GET /metrics``."""

from collections.abc import Mapping

from fastapi import APIRouter, Request, Response
from prometheus_client import (
    CONTENT_TYPE_LATEST,
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    generate_latest,
)
from prometheus_client.process_collector import ProcessCollector

from service.api.problems import responses

METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
UNMATCHED = "unmatched"
DURATION_BUCKETS_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)


class Metrics:
    """Counters of one app; labels are path templates and known methods, so their number is bounded."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
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
        self.in_flight = Gauge(
            "camind_depth_in_flight", "Photographs being worked on or waiting", registry=self.registry
        )
        self.in_progress = Gauge("camind_requests_in_progress", "Requests being answered", registry=self.registry)

    def count(self, method: str, path_template: str | None, status: int, duration_s: float) -> None:
        """One answered request; a path that no route has counts as ``unmatched``."""
        method = method if method in METHODS else "other"
        path = path_template or UNMATCHED
        self._requests.labels(method, path, str(status)).inc()
        self._duration_s.labels(method, path).observe(duration_s)

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
    """Requests by path template, method and status, their durations, and the process's memory and time."""
    metrics: Metrics = request.app.state.metrics
    return Response(generate_latest(metrics.registry), media_type=CONTENT_TYPE_LATEST)
