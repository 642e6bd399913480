"""Whatever a program sends that has read openapi.json, a started service answers as the document says.

``schemathesis.toml`` beside this file says which checks are wrong where; all others are on.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter

from model_export.started_server import Server, serving
from service.calibration.report import Result
from service.storage import schema
from service.storage.calibrations import CalibrationDraft, Calibrations, Ending
from service.storage.engine import open_engine
from tests.fake_calibration import RESULT, SETTINGS

ROOT = Path(__file__).parents[1]
CONFIG = ROOT / "tests" / "schemathesis.toml"
SCHEMATHESIS = Path(sys.executable).parent / "schemathesis"
CAMERA = {"image_width_px": 40, "image_height_px": 30, "focus_distance_m": 2.0, "k_cam_px": 3.0}
ENDED = "0123456789abcdef0123456789abcdef"
SEED = 20261121
PHASES = {"examples", "coverage", "fuzzing", "stateful"}
# test cases that a phase makes for one operation
FEW, MANY = 3, 150
LEAST, LEAST_SOAKED = 19 * 20, 3_000


@pytest.fixture
def server(tmp_path: Path, tiny_model_dir: Path) -> Iterator[Server]:
    """A service that has cameras, and a calibration that succeeded."""
    data_dir = tmp_path / "data"
    _store_calibration(data_dir)
    # photographs by the thousand must not wait for each other's calibrations
    with serving(data_dir, "--model", tiny_model_dir, settings={"CAMIND_CALIBRATION_QUEUE_SIZE": "100"}) as started:
        assert {started.add({**CAMERA, "name": name}) for name in ("frame", "spare")} == {201}
        yield started


def _store_calibration(data_dir: Path) -> None:
    engine = open_engine(f"sqlite:///{data_dir / 'camind.sqlite3'}")
    schema.upgrade(engine)
    calibrations = Calibrations(engine)
    calibrations.add(CalibrationDraft(ENDED, "another folder", "frame", SETTINGS, ()))
    assert calibrations.take("another folder")
    result = TypeAdapter(Result).dump_python(RESULT, mode="json")
    assert calibrations.finish(ENDED, Ending("succeeded", images=[], result=result))
    engine.dispose()


@pytest.mark.timeout(3600)
def test_the_service_keeps_to_its_description(server: Server, is_soak: bool, tmp_path: Path) -> None:
    found = tmp_path / "found.json"
    command: list[str | Path] = [SCHEMATHESIS, "--config-file", CONFIG, "run", "--no-color"]
    command += ["--max-examples", str(MANY if is_soak else FEW), "--seed", str(SEED), "--generation-database", "none"]
    command += ["--report", "json", "--report-json-path", found, f"http://127.0.0.1:{server.port}/openapi.json"]
    done = subprocess.run(
        command, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    report: dict[str, Any] = json.loads(found.read_text())
    assert report["operations"]["tested"] == report["operations"]["total"]
    assert {name for name, phase in report["phases"].items() if phase["status"] == "success"} == PHASES
    assert report["test_cases"]["generated"] >= (LEAST_SOAKED if is_soak else LEAST)
    assert '"level": "error"' not in server.log
