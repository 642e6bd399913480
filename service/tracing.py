"""Traces for an OpenTelemetry collector: one span a request. Nothing is imported where none is asked for."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING

from service.config import SettingsError

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import TracerProvider

# where a scope holds the milliseconds of a depth request's stages
STAGES_KEY = "camind.stages_ms"
NAME = "camind"
EXPORTER = "opentelemetry.exporter.otlp.proto.http.trace_exporter"
EXPORT_TIMEOUT_S = 5


@dataclass(frozen=True, slots=True)
class Trace:
    """What a span says of one request."""

    request_id: str
    method: str
    path_template: str | None
    status: int
    duration_s: float
    problem: str | None
    stages_ms: Mapping[str, float]


class Tracing:
    """Sends traces to a collector (OTLP over HTTP) in a thread of its own, between ``start`` and ``close``.

    Raises ``SettingsError`` where the extra is not installed.
    """

    def __init__(self, endpoint: str) -> None:
        try:
            import_module(EXPORTER)
        except ImportError as exc:
            raise SettingsError(
                f"Traces are to go to {endpoint}, and what sends them is not installed: pip install 'camind[otel]', "
                "or unset CAMIND_OTLP_ENDPOINT and OTEL_EXPORTER_OTLP_ENDPOINT."
            ) from exc
        self._url = f"{endpoint.rstrip('/')}/v1/traces"
        self._provider: TracerProvider | None = None

    def start(self) -> None:
        """Begin to send."""
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import OTELResourceDetector, Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor

        ours = Resource({"service.name": NAME, "service.version": version(NAME)})
        # the standard OTEL_SERVICE_NAME and OTEL_RESOURCE_ATTRIBUTES win
        theirs = OTELResourceDetector().detect()
        self._provider = TracerProvider(resource=ours.merge(theirs), shutdown_on_exit=False)
        exporter = OTLPSpanExporter(self._url, timeout=EXPORT_TIMEOUT_S)
        self._provider.add_span_processor(BatchSpanProcessor(exporter))

    def close(self) -> None:
        """Send what is left, and stop."""
        if self._provider is not None:
            self._provider.shutdown()
            self._provider = None

    def record(self, trace: Trace, headers: Mapping[str, str]) -> None:
        """One answered request, as a child of the span that its ``traceparent`` names."""
        if self._provider is None:
            return
        from opentelemetry.trace import SpanKind, StatusCode
        from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

        ended_ns = time.time_ns()
        parent = TraceContextTextMapPropagator().extract(dict(headers))
        span = self._provider.get_tracer(NAME).start_span(
            f"{trace.method} {trace.path_template or ''}".rstrip(),
            context=parent,
            kind=SpanKind.SERVER,
            start_time=ended_ns - round(trace.duration_s * 1e9),
            attributes={
                "http.request.method": trace.method,
                "http.response.status_code": trace.status,
                "camind.request_id": trace.request_id,
                **({"http.route": trace.path_template} if trace.path_template else {}),
                **({"error.type": trace.problem} if trace.problem else {}),
                **{f"camind.stage.{stage}_ms": value for stage, value in trace.stages_ms.items()},
            },
        )
        if trace.status >= 500:
            span.set_status(StatusCode.ERROR)
        span.end(ended_ns)
