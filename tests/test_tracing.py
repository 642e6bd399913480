"""Traces: what a real collector receives from a started service, and that nothing is imported without one."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from opentelemetry.proto.common.v1.common_pb2 import KeyValue
from opentelemetry.proto.trace.v1.trace_pb2 import Span, Status

from model_export.started_server import serving
from service.api.depth import STAGES
from tests.inference.photographs import corners, png

CAMERA = {"name": "bench", "image_width_px": 64, "image_height_px": 48, "focus_distance_m": 2.0, "k_cam_px": 3.0}
TRACE_ID = "0af7651916cd43dd8448eb211c80319c"
UNTRACED = """
import sys
from service.app import create_app
from service.config import Settings
create_app(Settings())
assert not [name for name in sys.modules if name.startswith("opentelemetry.sdk")]
"""
WITHOUT_THE_EXTRA = """
import sys

class Absent:
    def find_spec(name, path=None, target=None):
        if name.startswith("opentelemetry.exporter"):
            raise ModuleNotFoundError(name)

sys.meta_path.insert(0, Absent)
sys.argv = ["camind", "serve", "--port", "0"]
from service.cli import main
main()
"""


@contextmanager
def collector() -> Iterator[tuple[str, list[ExportTraceServiceRequest]]]:
    """A collector: its URL, and what it has received."""
    received: list[ExportTraceServiceRequest] = []

    class Receives(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            assert self.path == "/v1/traces"
            received.append(ExportTraceServiceRequest.FromString(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(200)
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Receives) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}", received
        finally:
            server.shutdown()
            thread.join()


def plain(attributes: Iterable[KeyValue]) -> dict[str, object]:
    return {item.key: getattr(item.value, str(item.value.WhichOneof("value"))) for item in attributes}


def test_a_request_is_a_span_with_its_route_id_and_stages(tmp_path: Path, tiny_model_dir: Path) -> None:
    with collector() as (url, received):
        settings = {"OTEL_EXPORTER_OTLP_ENDPOINT": url, "OTEL_RESOURCE_ATTRIBUTES": "deployment.environment.name=test"}
        with serving(tmp_path / "data", "--model", tiny_model_dir, settings=settings) as server:
            server.add(CAMERA)
            headers = {
                "Content-Type": "image/png",
                "X-Request-Id": "mine",
                "traceparent": f"00-{TRACE_ID}-b7ad6b7169203331-01",
            }
            assert server.ask("POST", "/depth?camera=bench", png(corners()), headers).status == 200
            assert server.ask("GET", "/cameras/secret-name").status == 404
            assert server.ask("GET", "/wp-admin/secret-path").status == 404
            server.stop(signal.SIGTERM)
    resources = [batch.resource for request in received for batch in request.resource_spans]
    told = plain(resources[0].attributes)
    assert told["service.name"] == "camind"
    assert told["deployment.environment.name"] == "test"
    spans = [
        span
        for request in received
        for batch in request.resource_spans
        for scope in batch.scope_spans
        for span in scope.spans
    ]
    by_name = {span.name: span for span in spans}
    depth = by_name["POST /depth"]
    attributes = plain(depth.attributes)
    assert attributes["http.route"] == "/depth"
    assert attributes["camind.request_id"] == "mine"
    assert attributes["http.response.status_code"] == 200
    assert {f"camind.stage.{stage}_ms" for stage in STAGES} <= set(attributes)
    assert depth.kind == Span.SPAN_KIND_SERVER
    assert (depth.trace_id.hex(), depth.parent_span_id.hex()) == (TRACE_ID, "b7ad6b7169203331")
    assert 0 < depth.end_time_unix_nano - depth.start_time_unix_nano < 60e9
    missing = by_name["GET /cameras/{name}"]
    assert plain(missing.attributes)["error.type"] == "not-found"
    assert missing.status.code == Status.STATUS_CODE_UNSET
    assert "GET" in by_name
    assert b"secret" not in b"".join(request.SerializeToString() for request in received)


def test_a_collector_that_is_gone_holds_nothing_up(tmp_path: Path, tiny_model_dir: Path) -> None:
    settings = {"CAMIND_OTLP_ENDPOINT": "http://127.0.0.1:1"}
    with serving(tmp_path / "data", "--model", tiny_model_dir, settings=settings) as server:
        assert server.ask("GET", "/health/live").status == 200
        began = time.monotonic()
        server.stop(signal.SIGTERM)
        assert time.monotonic() - began < 25


def test_nothing_is_imported_without_an_endpoint(tmp_path: Path) -> None:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("OTEL_")}
    environment["CAMIND_DATA_DIR"] = str(tmp_path)
    subprocess.run([sys.executable, "-c", UNTRACED], env=environment, check=True)


def test_a_missing_extra_is_said_before_anything_starts(tmp_path: Path) -> None:
    environment = {**os.environ, "CAMIND_DATA_DIR": str(tmp_path), "CAMIND_OTLP_ENDPOINT": "http://127.0.0.1:4318"}
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_THE_EXTRA], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert "camind[otel]" in done.stderr
    assert "Traceback" not in done.stderr
