"""Whatever a process was doing when it was killed: what it acknowledged is there after the next start, and no more.

Threads register, replace and delete cameras of their own, so that each camera's state is known but for the one request
that the kill interrupts, and queue small calibrations, each of which gives a camera one revision.
"""

import http.client
import json
import random
import signal
import sqlite3
import threading
from collections import Counter
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import pytest

from model_export.started_server import Server, serving
from tests.fake_calibration import calibration_form
from tests.held_server import GO, ended_calibration, folders, write_command
from tests.inference.photographs import corners, png

ROUNDS, SOAK_ROUNDS = 3, 100
CAMERA_THREADS, CALIBRATION_THREADS, NAMES = 3, 2, 3
SHORTEST_S, LONGEST_S = 0.05, 1.5
JSON = {"Content-Type": "application/json"}
BASE = {"image_width_px": 4, "image_height_px": 3, "focus_distance_m": 1.0}


@dataclass(frozen=True, slots=True)
class State:
    """How often a name was written to, and the k_cam it has; None where it is free."""

    revision: int = 0
    k_cam_px: float | None = None


@dataclass(slots=True)
class Known:
    """What was acknowledged of a name, and what the request that was not answered would have made of it."""

    state: State = field(default_factory=State)
    interrupted: State | None = None


class Round:
    """A server under load until it is killed; ``known`` and ``calibrations`` go from round to round."""

    def __init__(self, server: Server, known: dict[str, Known], calibrations: list[str], counts: Counter[str]) -> None:
        self._server = server
        self._known = known
        self._calibrations = calibrations
        self._counts = counts
        self._threads = [threading.Thread(target=partial(self._use_cameras, n)) for n in range(CAMERA_THREADS)]
        self._threads += [threading.Thread(target=partial(self._calibrate, n)) for n in range(CALIBRATION_THREADS)]

    def kill_after(self, seconds: float) -> None:
        for thread in self._threads:
            thread.start()
        threading.Event().wait(seconds)
        self._server.stop(signal.SIGKILL)
        for thread in self._threads:
            thread.join()

    def _use_cameras(self, number: int) -> None:
        chance = random.Random()
        while True:
            name = f"camera-{number}-{chance.randrange(NAMES)}"
            known = self._known.setdefault(name, Known())
            before, k_cam_px = known.state, chance.randint(1, 10**6) / 1e4
            body = {**BASE, "k_cam_px": k_cam_px}
            if before.k_cam_px is None:
                after, wanted = State(before.revision + 1, k_cam_px), 201
                request = ("POST", "/cameras", json.dumps({"name": name, **body}), JSON)
            elif chance.random() < 0.7:
                after, wanted = State(before.revision + 1, k_cam_px), 200
                request = ("PUT", f"/cameras/{name}", json.dumps(body), JSON)
            else:
                after, wanted = State(before.revision), 204
                request = ("DELETE", f"/cameras/{name}", "", {})
            known.interrupted = after
            try:
                status = self._server.ask(*request).status
            except (OSError, http.client.HTTPException):
                return
            known.interrupted = None
            if status == wanted:
                known.state = after
                self._counts["acknowledged writes to cameras"] += 1
            elif status != 503:
                raise AssertionError(f"{request[0]} of {name} was answered {status}")

    def _calibrate(self, number: int) -> None:
        form = calibration_form(png(corners()), register=True)
        headers = {"Content-Type": form.headers["content-type"]}
        while True:
            try:
                reply = self._server.ask("POST", f"/calibrate?camera=calibrated-{number}", form.content, headers)
            except (OSError, http.client.HTTPException):
                return
            if reply.status == 202:
                self._calibrations.append(reply.headers["location"])
                self._counts["acknowledged calibrations"] += 1
            else:
                # as many wait as may
                assert reply.status == 503
                threading.Event().wait(0.02)


def check(
    server: Server, data_dir: Path, known: dict[str, Known], calibrations: list[str], counts: Counter[str]
) -> None:
    """Everything that was acknowledged is there, whole, and the spool is worked off."""
    for name, each in known.items():
        reply = server.ask("GET", f"/cameras/{name}")
        assert reply.status in (200, 404)
        found = (reply.json()["revision"], reply.json()["k_cam_px"]) if reply.status == 200 else None
        possible = [state for state in (each.state, each.interrupted) if state is not None]
        fitting = [state for state in possible if found == (state.k_cam_px and (state.revision, state.k_cam_px))]
        assert fitting, (name, found, each)
        counts["interrupted writes that were stored"] += fitting[0] is each.interrupted
        counts["interrupted writes that were not"] += each.interrupted is not None and fitting[0] is each.state
        each.state, each.interrupted = fitting[0], None
    for path in calibrations:
        assert ended_calibration(server, path)["state"] == "succeeded"
    server.poll(lambda: not folders(data_dir))
    with closing(sqlite3.connect(data_dir / "camind.sqlite3")) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        assert connection.execute("PRAGMA foreign_key_check").fetchall() == []
        assert connection.execute("SELECT count(*) FROM calibrations WHERE state != 'succeeded'").fetchone() == (0,)
        ended = Counter(name for (name,) in connection.execute("SELECT camera FROM calibrations"))
    for name, count in ended.items():
        assert server.ask("GET", f"/cameras/{name}").json()["revision"] == count
    counts["stored calibrations"] = ended.total()


@pytest.mark.timeout(7200)
def test_what_was_acknowledged_survives_kills(tmp_path: Path, tiny_model_dir: Path, is_soak: bool) -> None:
    data_dir = tmp_path / "data"
    data_dir.mkdir()
    (data_dir / GO).touch()
    program = write_command(tmp_path)
    known, calibrations, counts = dict[str, Known](), list[str](), Counter[str]()
    settings = {"CAMIND_DRAIN_S": "0", "CAMIND_LOG_LEVEL": "error", "CAMIND_CALIBRATION_QUEUE_SIZE": "4"}
    rounds, checked = SOAK_ROUNDS if is_soak else ROUNDS, 0
    for number in range(rounds + 1):
        with serving(data_dir, "--model", tiny_model_dir, camind=program, settings=settings) as server:
            check(server, data_dir, known, calibrations[checked:], counts)
            checked = len(calibrations)
            assert "Traceback" not in server.log
            if number < rounds:
                Round(server, known, calibrations, counts).kill_after(random.uniform(SHORTEST_S, LONGEST_S))
                counts["kills"] += 1
            else:
                for path in calibrations:
                    assert server.ask("GET", path).json()["state"] == "succeeded"
                assert server.stop(signal.SIGTERM) == 0
    print(f"{dict(counts)}")
    assert counts["acknowledged writes to cameras"] > 0
    assert counts["acknowledged calibrations"] > 0
