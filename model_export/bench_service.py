"""How fast the service answers over HTTP: a request by its stages, many clients at once, and the memory it takes."""

import http.client
import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from model_export.bench_graphs import NATIVE_K_CAM_PX, SIZE, Timing, draw_picture

CLIENTS = (1, 2, 4, 8, 16)
FULL_SIZE = (4000, 3000)
PHOTOGRAPHS_K_CAM_PX = (NATIVE_K_CAM_PX, 50.0)
START_S = 60
PERCENTILES = (50, 95, 99)
JPEG_QUALITY = 90


@dataclass(frozen=True, slots=True)
class Reply:
    status: int
    headers: dict[str, str]


class Service:
    """A ``camind serve`` in a process of its own, with a folder of its own."""

    def __init__(self, model: Path, folder: Path) -> None:
        settings = {
            "CAMIND_DATA_DIR": str(folder / "data"),
            "CAMIND_MODEL_DIR": str(model),
            "CAMIND_LOG_FORMAT": "json",
        }
        self._log = folder / "service.log"
        command = [str(Path(sys.executable).parent / "camind"), "serve", "--port", "0"]
        with self._log.open("w") as log:
            self.process = subprocess.Popen(command, env={**os.environ, **settings}, stderr=log)
        self.port = self._started()

    def _started(self) -> int:
        give_up = time.monotonic() + START_S
        while time.monotonic() < give_up and self.process.poll() is None:
            if found := re.search(r"camind on http://127\.0\.0\.1:(\d+)", self._log.read_text()):
                self.port = int(found[1])
                if self.ask("GET", "/health/ready").status == http.HTTPStatus.OK:
                    return self.port
            time.sleep(0.05)
        raise RuntimeError(f"the service did not start:\n{self._log.read_text()}")

    def ask(self, method: str, path: str, body: bytes | None = None, kind: str = "image/jpeg") -> Reply:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=600)
        try:
            connection.request(method, path, body, {"Content-Type": kind} if body else {})
            answer = connection.getresponse()
            answer.read()
            return Reply(answer.status, {name.lower(): value for name, value in answer.getheaders()})
        finally:
            connection.close()

    def register(self, name: str, width_px: int, height_px: int, k_cam_px: float) -> None:
        camera = {"name": name, "image_width_px": width_px, "image_height_px": height_px}
        camera |= {"focus_distance_m": 2.0, "k_cam_px": k_cam_px}
        self.ask("POST", "/cameras", json.dumps(camera).encode(), "application/json")

    def memory_mb(self, what: str) -> float:
        """``VmHWM``, the most the process has held, or ``VmRSS``, what it holds; NaN where /proc does not say."""
        try:
            status = Path(f"/proc/{self.process.pid}/status").read_text()
        except FileNotFoundError:
            return float("nan")
        return int(re.findall(rf"{what}:\s+(\d+) kB", status)[0]) / 1000


@contextmanager
def serving(model: Path) -> Iterator[Service]:
    """A service for a while."""
    with tempfile.TemporaryDirectory() as folder:
        service = Service(model.absolute(), Path(folder))
        try:
            yield service
        finally:
            service.process.terminate()
            service.process.wait(timeout=START_S)


def _jpeg(width_px: int, height_px: int) -> bytes:
    picture = cv2.cvtColor(draw_picture(width_px, height_px), cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", picture, (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY))[1].tobytes()


@dataclass(frozen=True, slots=True)
class RequestRow:
    """A JPEG sent, a 16-bit PNG back: seconds seen by the client, medians of the stages told, and what is no graph."""

    name: str
    pixels: int
    timing: Timing
    stages_ms: dict[str, float]
    around_graphs_ms: float


def time_frames(service: Service, rounds: int, on_round: Callable[[], None] = lambda: None) -> RequestRow:
    """A 640x480 frame, as a robot sends them."""
    row = _timed(service, "frame", SIZE, 3.81, rounds)
    on_round()
    return row


def time_photographs(service: Service, rounds: int, on_round: Callable[[], None] = lambda: None) -> list[RequestRow]:
    """A 12-megapixel photograph by cameras whose blur is read at full size, and at a fraction of it."""
    rows = []
    for k_cam_px in PHOTOGRAPHS_K_CAM_PX:
        rows.append(_timed(service, f"photograph-{k_cam_px:g}", FULL_SIZE, k_cam_px, rounds))
        on_round()
    return rows


def _timed(service: Service, camera: str, size: tuple[int, int], k_cam_px: float, rounds: int) -> RequestRow:
    service.register(camera, *size, k_cam_px)
    body = _jpeg(*size)
    seconds, told = [], []
    for number in range(rounds + 1):
        started = time.perf_counter()
        reply = service.ask("POST", f"/depth?camera={camera}", body)
        if number:
            seconds.append(time.perf_counter() - started)
            told.append(_stages(reply))
    stages = {stage: float(np.median([each[stage] for each in told])) for stage in told[0]}
    around = [1e3 * s - each["blur"] - each["depth"] for s, each in zip(seconds, told, strict=True)]
    label = f"{size[0]}x{size[1]}, k_cam {k_cam_px:g} px"
    return RequestRow(label, size[0] * size[1], Timing(tuple(seconds)), stages, float(np.median(around)))


def _stages(reply: Reply) -> dict[str, float]:
    parts = (part.split(";dur=") for part in reply.headers["server-timing"].split(", "))
    return {stage: float(ms) for stage, ms in parts}


@dataclass(frozen=True, slots=True)
class LoadRow:
    """So many clients, each sending its next frame when the last one is answered."""

    clients: int
    answered: int
    refused: int
    failed: int
    per_second: float
    percentiles_s: dict[int, float]
    memory_mb: float


def time_load(service: Service, seconds: float, on_round: Callable[[], None] = lambda: None) -> list[LoadRow]:
    """Throughput, latency and memory by the number of clients; a refusal is a 503 that says when to come back."""
    service.register("load", *SIZE, 3.81)
    body = _jpeg(*SIZE)
    rows = []
    for clients in CLIENTS:
        seen: list[tuple[Reply, float]] = []
        stop = time.monotonic() + seconds
        threads = [threading.Thread(target=_client, args=(service, body, stop, seen)) for _ in range(clients)]
        started = time.perf_counter()
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        spent_s = time.perf_counter() - started
        times = [s for reply, s in seen if reply.status == http.HTTPStatus.OK]
        refused = sum(r.status == http.HTTPStatus.SERVICE_UNAVAILABLE and "retry-after" in r.headers for r, _ in seen)
        rows.append(
            LoadRow(
                clients,
                len(times),
                refused,
                len(seen) - len(times) - refused,
                len(times) / spent_s,
                {p: float(np.percentile(times, p)) if times else float("nan") for p in PERCENTILES},
                service.memory_mb("VmRSS"),
            )
        )
        on_round()
    return rows


def _client(service: Service, body: bytes, stop: float, seen: list[tuple[Reply, float]]) -> None:
    while time.monotonic() < stop:
        started = time.perf_counter()
        reply = service.ask("POST", "/depth?camera=load", body)
        seen.append((reply, time.perf_counter() - started))
