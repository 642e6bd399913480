"""``camind serve`` with a stand-in for the calibration, held unless the data folder has a file ``go``."""

import sys
from pathlib import Path
from typing import Any

from model_export.started_server import Server
from service import logs, server
from service.app import create_app
from service.config import load_settings
from tests.fake_calibration import FakeCalibration

GO = "go"


def write_command(folder: Path) -> Path:
    """A program that starts it."""
    program = folder / "held-camind"
    program.write_text(f"#!{sys.executable}\nfrom tests.held_server import main\nmain()\n")
    program.chmod(0o755)
    return program


def ended_calibration(server: Server, path: str) -> dict[str, Any]:
    """A calibration, once it has ended."""

    def look() -> dict[str, Any] | None:
        body = server.ask("GET", path).json()
        return None if body["state"] in ("queued", "running") else body

    return server.poll(look)


def folders(data_dir: Path) -> list[str]:
    """The calibrations whose photographs are there."""
    return [path.name for path in (data_dir / "calibrations").iterdir() if path.is_dir()]


def main() -> None:
    """Serve with the model folder that follows ``--model``, on a port the system chooses."""
    settings = load_settings(port=0, model_dir=Path(sys.argv[sys.argv.index("--model") + 1]))
    logs.configure(settings.log_level, settings.log_format)
    listener = server.bind(settings.host, settings.port)
    sys.stderr.write(f"camind on http://{settings.host}:{listener.getsockname()[1]}\n")
    sys.stderr.flush()
    fake = FakeCalibration(is_held=not (settings.data_dir / GO).exists())
    server.serve(create_app(settings, fake), settings, listener)
