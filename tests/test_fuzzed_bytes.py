"""Whatever bytes come, the answer is metres or a problem, and the process lives, within its memory."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from model_export.started_server import Reply, Server, serving
from tests.fuzzed_requests import Request, request

ROUNDS, SOAK_ROUNDS = 300, 20_000
PEAK_BYTES = 800_000_000
PROBLEM = "application/problem+json"
CAMERA = {"name": "bench", "image_width_px": 64, "image_height_px": 48, "focus_distance_m": 2.0, "k_cam_px": 6.0}
INSIDE = re.compile(rb"Traceback|File \"|site-packages|\.py\b|/tmp/|/home/|sqlite|libpng| at 0x")


def require_answer(reply: Reply) -> None:
    if reply.status < 300:
        return
    assert reply.headers["content-type"] == PROBLEM
    assert reply.json()["status"] == reply.status
    assert reply.status < 500 or reply.status == 507 or (reply.status == 503 and reply.headers["retry-after"])
    assert not INSIDE.search(reply.body), reply.body


def send(server: Server, number: int, one: Request, folder: Path) -> int:
    """Send it; what went wrong names the number that makes it again, and leaves the body in a file."""
    try:
        reply = server.ask("POST", one.path, one.body, {"Content-Type": one.content_type})
        require_answer(reply)
    except (AssertionError, OSError, KeyError, ValueError) as exc:
        (folder / "body").write_bytes(one.body)
        raise AssertionError(f"request({number}) to {one.path}, {one.content_type}: {folder / 'body'}") from exc
    if reply.status == 202:
        server.ask("DELETE", reply.headers["location"])
    return reply.status


@pytest.mark.timeout(4 * 3600)
def test_no_bytes_break_the_service(tmp_path: Path, tiny_model_dir: Path, is_soak: bool) -> None:
    statuses: dict[int, int] = {}
    settings = {"CAMIND_CALIBRATION_QUEUE_SIZE": "1000", "CAMIND_LOG_LEVEL": "debug"}
    with serving(tmp_path / "data", "--model", tiny_model_dir, settings=settings) as server:
        assert server.add(CAMERA) == 201
        for number in range(SOAK_ROUNDS if is_soak else ROUNDS):
            status = send(server, number, request(number), tmp_path)
            statuses[status] = statuses.get(status, 0) + 1
        assert server.process.poll() is None
        assert server.ask("GET", "/health/ready").status == 200
        assert server.peak_memory_bytes < PEAK_BYTES
        events: list[dict[str, Any]] = [json.loads(line) for line in server.log.splitlines() if line.startswith("{")]
        faults = [event for event in events if event["level"] in ("error", "critical")]
        assert not faults, faults[:3]
        print(f"\n{statuses}, peak {server.peak_memory_bytes / 1e6:.0f} MB")
    # enough of them got far: a fuzzer that is refused at the door finds nothing
    assert statuses[200] > sum(statuses.values()) * 0.1
