"""After many requests of all kinds, right and wrong, the process holds no more memory, files or threads than before."""

import json
import random
import threading
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from model_export.started_server import Server, serving
from tests.fake_calibration import calibration_form
from tests.held_server import GO, write_command
from tests.inference.photographs import corners, jpeg, png

REQUESTS, SOAK_REQUESTS = 100, 10_000
CLIENTS = 4
# in the short version the caches of libraries still fill
MOST_GROWTH, SOAK_MOST_GROWTH = 0.2, 0.05
FORMATS = ("png", "npy", "npz", "tiff", "ply", "preview", "json")
JSON = {"Content-Type": "application/json"}
CAMERA = {"image_width_px": 64, "image_height_px": 48, "focus_distance_m": 1.0, "k_cam_px": 2.0}
PHOTOGRAPH = {"Content-Type": "image/jpeg"}


class Client:
    """Sends requests of all kinds, and counts the answers."""

    def __init__(self, server: Server, seed: int) -> None:
        self._server = server
        self._chance = random.Random(seed)
        self._camera = f"own-{seed}"
        self._photographs = [jpeg(corners(48 * scale, 64 * scale)) for scale in (1, 2, 4)]
        self._form = calibration_form(png(corners()), register=True)
        self.statuses: Counter[str] = Counter()

    def send(self) -> None:
        """One request, or the beginning of one."""
        kinds = (self._ask_depth,) * 5 + (self._use_camera,) * 3 + (self._read, self._err, self._err, self._leave)
        kind = self._chance.choice(kinds) if self._chance.random() > 0.03 else self._calibrate
        self.statuses[f"{kind.__name__.strip('_')} {kind()}"] += 1

    def _ask_depth(self) -> int:
        photograph, kind = self._chance.choice(self._photographs), self._chance.choice(FORMATS)
        return self._server.ask("POST", f"/depth?camera=shared&format={kind}&at=3,4", photograph, PHOTOGRAPH).status

    def _use_camera(self) -> int:
        path, body = f"/cameras/{self._camera}", {**CAMERA, "k_cam_px": self._chance.random() + 1}
        if self._server.ask("GET", path).status == 404:
            return self._server.add({"name": self._camera, **body})
        if self._chance.random() < 0.5:
            return self._server.ask("PUT", path, json.dumps(body), JSON).status
        return self._server.ask("DELETE", path).status

    def _read(self) -> int:
        paths = ("/cameras", "/cameras/shared/curve", "/calibrations", "/metrics", "/model", "/health/ready", "/docs")
        return self._server.ask("GET", self._chance.choice(paths)).status

    def _err(self) -> int:
        wrong: tuple[tuple[str, str, bytes, dict[str, str]], ...] = (
            ("POST", "/depth?camera=shared", self._photographs[0][:200], PHOTOGRAPH),
            ("POST", "/depth?camera=nobody", self._photographs[0], PHOTOGRAPH),
            ("POST", "/depth?camera=shared", jpeg(corners(40, 60)), PHOTOGRAPH),
            ("POST", "/cameras", b"{", JSON),
            ("POST", "/calibrate?camera=shared", b"x" * 1000, {"Content-Type": "multipart/form-data; boundary=b"}),
            ("GET", f"/nothing/{self._chance.random()}", b"", {}),
            ("PATCH", "/cameras", b"", {}),
        )
        method, path, body, headers = self._chance.choice(wrong)
        return self._server.ask(method, path, body, headers).status

    def _leave(self) -> int:
        path, body, kind = self._chance.choice(
            (
                ("/depth?camera=shared", self._photographs[2], "image/jpeg"),
                ("/calibrate?camera=shared", self._form.content, self._form.headers["content-type"]),
            )
        )
        head = f"POST {path} HTTP/1.1\r\nHost: x\r\nContent-Type: {kind}\r\nContent-Length: {len(body)}\r\n\r\n"
        with self._server.connect() as connection:
            connection.sendall(head.encode() + body[: self._chance.randrange(len(body) + 1)])
        return 0

    def _calibrate(self) -> int:
        headers = {"Content-Type": self._form.headers["content-type"]}
        return self._server.ask("POST", "/calibrate?camera=calibrated", self._form.content, headers).status


def held(server: Server) -> tuple[int, int, int]:
    """Memory in bytes, open files and threads, once nothing is being done."""
    server.poll(lambda: "camind_requests_in_progress 1.0" in server.ask("GET", "/metrics").body.decode())
    process = Path(f"/proc/{server.process.pid}")
    threading.Event().wait(1)
    return server.memory_bytes, len(list((process / "fd").iterdir())), len(list((process / "task").iterdir()))


@pytest.mark.timeout(7200)
def test_nothing_grows(tmp_path: Path, tiny_model_dir: Path, is_soak: bool) -> None:
    data_dir = tmp_path / "data"
    data_dir.mkdir()
    (data_dir / GO).touch()
    settings = {"CAMIND_LOG_LEVEL": "error", "CAMIND_DRAIN_S": "0"}
    requests = SOAK_REQUESTS if is_soak else REQUESTS
    with serving(data_dir, "--model", tiny_model_dir, camind=write_command(tmp_path), settings=settings) as server:
        assert server.add({"name": "shared", **CAMERA}) == 201
        clients = [Client(server, seed) for seed in range(CLIENTS)]

        def send(count: int) -> None:
            with ThreadPoolExecutor(CLIENTS) as pool:
                for future in [pool.submit(clients[number % CLIENTS].send) for number in range(count)]:
                    future.result()

        send(requests // 5 if is_soak else requests)
        before = held(server)
        send(requests)
        after = held(server)
        statuses = sum((client.statuses for client in clients), Counter[str]())
        print(f"{before} became {after} after {requests} requests: {dict(statuses)}")
        assert "Traceback" not in server.log
        server.poll(lambda: not [path for path in (data_dir / "calibrations").iterdir() if path.is_dir()])
    assert not [key for key in statuses if key.endswith(" 500")]
    assert after[0] < before[0] * (1 + (SOAK_MOST_GROWTH if is_soak else MOST_GROWTH))
    # a client may have come and a thread of a pool begun meanwhile
    assert after[1] <= before[1] + 4
    assert after[2] <= before[2] + 4
