"""Blender's own environment, made on demand, and scripts that run in it, one on each core.

Blender comes as a Python module that cannot share an environment with ours.
"""

import json
import shutil
import subprocess
import tempfile
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Lock
from typing import TypeVar

from service.cores import available_cores

BPY = "bpy==5.0.1"
COMPLETE = "camind-complete"  # in an environment that an installation has not left half-way
PYTHON = "python3.11"

Item = TypeVar("Item")


def environment(folder: Path) -> Path:
    """The Python of an environment that has Blender; made in ``folder`` if it is not there yet (370 MB).

    Raises ``FileNotFoundError`` without the Python that Blender is built for, ``ChildProcessError`` if it cannot be
    installed.
    """
    python, complete = folder / "bin" / "python", folder / COMPLETE
    if complete.exists():
        return python
    base = shutil.which(PYTHON)
    if base is None:
        raise FileNotFoundError(f"{BPY} needs {PYTHON}, which is not on the path")
    for command in ([base, "-m", "venv", str(folder)], [str(python), "-m", "pip", "install", "--quiet", BPY]):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise ChildProcessError(f"{' '.join(command)} failed: {done.stderr.strip()[-500:]}")
    complete.touch()
    return python


def shares(items: Sequence[Item]) -> list[list[Item]]:
    """Each core's part of a work, as nearly alike as may be; at least one part."""
    count = max(1, min(available_cores(), len(items)))
    return [list(items[first::count]) for first in range(count)]


def run_workers(
    python: Path, worker: Path, specs: Sequence[object], out: Path, on_progress: Callable[[str], None]
) -> None:
    """``run_worker`` on each specification, side by side; ``on_progress`` is called by one at a time.

    Each has a core of its own: making a scene ready takes one however many there are.
    """
    telling = Lock()

    def tell(name: str) -> None:
        with telling:
            on_progress(name)

    with ThreadPoolExecutor(len(specs)) as pool:
        for _ in pool.map(lambda spec: run_worker(python, worker, spec, out, tell), specs):
            pass


def run_worker(python: Path, worker: Path, spec: object, out: Path, on_progress: Callable[[str], None]) -> None:
    """Have Blender's Python run a script on a specification in JSON and a folder; each file's name as it is done.

    Raises ``ChildProcessError`` with the script's last words if it fails.
    """
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        told = Path(scratch) / "spec.json"
        told.write_text(json.dumps(spec))
        command = [str(python), str(worker), str(told), str(out)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as running:
            said: deque[str] = deque(maxlen=10)
            for line in running.stdout or ():
                said.append(line)
                if line.startswith("rendered "):
                    on_progress(line.split()[1])
        if running.returncode:
            raise ChildProcessError(f"Blender failed: {''.join(said)}")
