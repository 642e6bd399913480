"""How fast the service answers over HTTP: a request by its stages, many clients at once, and the memory it takes."""

import threading
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from http import HTTPStatus
from http.client import HTTPConnection

import numpy as np

from model_export.bench_graphs import FRAME_K_CAM_PX, NATIVE_K_CAM_PX, SIZE, Timing, draw_picture
from model_export.started_server import Reply, Server, ask_over
from service.inference.encode import encode_photograph

CLIENTS = (1, 2, 4, 8, 16)
FULL_SIZE = (4000, 3000)
PHOTOGRAPHS_K_CAM_PX = (NATIVE_K_CAM_PX, 50.0)
PERCENTILES = (50, 95, 99)


def _jpeg(width_px: int, height_px: int) -> bytes:
    return encode_photograph(draw_picture(width_px, height_px), max(width_px, height_px)).body


@dataclass(frozen=True, slots=True)
class RequestRow:
    """A JPEG sent, a 16-bit PNG back: seconds seen by the client, medians of the stages told, and what is no graph."""

    name: str
    timing: Timing
    stages_ms: dict[str, float]
    around_graphs_ms: float


def time_frames(server: Server, rounds: int, on_round: Callable[[], None]) -> RequestRow:
    """A 640x480 frame, as a robot sends them: one after the other over one connection."""
    row = _timed(server, "frame", SIZE, FRAME_K_CAM_PX, rounds)
    on_round()
    return row


def time_photographs(server: Server, rounds: int, on_round: Callable[[], None]) -> list[RequestRow]:
    """A 12-megapixel photograph by cameras whose blur is read at full size, and at a fraction of it."""
    rows = []
    for k_cam_px in PHOTOGRAPHS_K_CAM_PX:
        rows.append(_timed(server, f"photograph-{k_cam_px:g}", FULL_SIZE, k_cam_px, rounds))
        on_round()
    return rows


def _timed(server: Server, camera: str, size: tuple[int, int], k_cam_px: float, rounds: int) -> RequestRow:
    _register(server, camera, size, k_cam_px)
    body = _jpeg(*size)
    seconds, told = [], []
    with closing(server.keep_connection()) as connection:
        for number in range(rounds + 1):
            started = time.perf_counter()
            reply = _ask(connection, camera, body)
            if number:
                seconds.append(time.perf_counter() - started)
                told.append(_stages(reply))
    stages = {stage: float(np.median([each[stage] for each in told])) for stage in told[0]}
    around = [1e3 * s - each["blur"] - each["depth"] for s, each in zip(seconds, told, strict=True)]
    label = f"{size[0]}x{size[1]}, k_cam {k_cam_px:g} px"
    return RequestRow(label, Timing(tuple(seconds)), stages, float(np.median(around)))


def _register(server: Server, name: str, size: tuple[int, int], k_cam_px: float) -> None:
    server.add(
        {
            "name": name,
            "image_width_px": size[0],
            "image_height_px": size[1],
            "focus_distance_m": 2.0,
            "k_cam_px": k_cam_px,
        }
    )


def _ask(connection: HTTPConnection, camera: str, body: bytes) -> Reply:
    return ask_over(connection, "POST", f"/depth?camera={camera}", body, {"Content-Type": "image/jpeg"})


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

    @property
    def predicted_s(self) -> float:
        """How long an answer takes where so many clients wait for a service of that rate (Little's law)."""
        return self.clients / self.per_second if self.per_second else float("nan")


def time_load(server: Server, seconds: float, on_round: Callable[[], None] = lambda: None) -> list[LoadRow]:
    """Throughput, latency and memory by the number of clients; a refusal is a 503 that says when to come back."""
    _register(server, "load", SIZE, FRAME_K_CAM_PX)
    body = _jpeg(*SIZE)
    rows = []
    for clients in CLIENTS:
        seen: list[tuple[Reply, float]] = []
        stop = time.monotonic() + seconds
        threads = [threading.Thread(target=_client, args=(server, body, stop, seen)) for _ in range(clients)]
        started = time.perf_counter()
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        spent_s = time.perf_counter() - started
        times = [s for reply, s in seen if reply.status == HTTPStatus.OK]
        refused = sum(r.status == HTTPStatus.SERVICE_UNAVAILABLE and "retry-after" in r.headers for r, _ in seen)
        rows.append(
            LoadRow(
                clients,
                len(times),
                refused,
                len(seen) - len(times) - refused,
                len(times) / spent_s,
                {p: float(np.percentile(times, p)) if times else float("nan") for p in PERCENTILES},
                server.memory_bytes / 1e6,
            )
        )
        on_round()
    return rows


def _client(server: Server, body: bytes, stop: float, seen: list[tuple[Reply, float]]) -> None:
    with closing(server.keep_connection()) as connection:
        while time.monotonic() < stop:
            started = time.perf_counter()
            reply = _ask(connection, "load", body)
            seen.append((reply, time.perf_counter() - started))
