"""``camind serve`` whose calibrations are held: by a stand-in unless the data folder has a file ``go``, or the real
ones, once a photograph was looked at, while it has a file ``hold``.
"""

import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

from model_export.started_server import Server
from service import app, logs, server
from service.calibration.report import PictureReport, Report
from service.calibration.task import Picture, Task, Tell
from service.config import Settings, load_settings
from service.runner import Calibrate
from tests.fake_calibration import FakeCalibration

GO = "go"
HOLD = "hold"


def write_command(folder: Path, calibration: Literal["stand_in", "real"] = "stand_in") -> Path:
    """A program that starts it."""
    program = folder / "held-camind"
    program.write_text(
        f"#!{sys.executable}\nfrom tests import held_server\nheld_server.main(held_server.{calibration})\n"
    )
    program.chmod(0o755)
    return program


def stand_in(settings: Settings) -> Calibrate:
    return FakeCalibration(is_held=not (settings.data_dir / GO).exists())


def real(settings: Settings) -> Calibrate:
    def calibrate(task: Task, pictures: Sequence[Picture], tell: Tell, check: Callable[[], None]) -> Report:
        def told(progress: float, reports: tuple[PictureReport, ...]) -> None:
            tell(progress, reports)
            while reports and (settings.data_dir / HOLD).exists():
                check()
                tell(progress, reports)
                time.sleep(0.01)

        return app.calibrate(task, pictures, told, check)

    return calibrate


def ended_calibration(server: Server, path: str) -> dict[str, Any]:
    """A calibration, once it has ended."""

    def look() -> dict[str, Any] | None:
        body = server.ask("GET", path).json()
        return None if body["state"] in ("queued", "running") else body

    return server.poll(look)


def folders(data_dir: Path) -> list[str]:
    """The calibrations whose photographs are there."""
    return [path.name for path in (data_dir / "calibrations").iterdir() if path.is_dir()]


def main(calibration: Callable[[Settings], Calibrate]) -> None:
    """Serve with the model folder that follows ``--model``, on a port the system chooses."""
    settings = load_settings(port=0, model_dir=Path(sys.argv[sys.argv.index("--model") + 1]))
    logs.configure(settings.log_level, settings.log_format)
    listener = server.bind(settings.host, settings.port)
    sys.stderr.write(f"camind on http://{settings.host}:{listener.getsockname()[1]}\n")
    sys.stderr.flush()
    server.serve(app.create_app(settings, calibration(settings)), settings, listener)
