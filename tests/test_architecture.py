"""House rules that no linter knows."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SERVICE = sorted((ROOT / "service").rglob("*.py"))
OPTICS = sorted((ROOT / "service" / "optics").rglob("*.py"))

BLOCKED = """
import sys

class Absent:
    def find_spec(name, path=None, target=None):
        if name in ("torch", "onnx", "onnxscript", "model_export"):
            raise ModuleNotFoundError(name)

sys.meta_path.insert(0, Absent)
import service.app, service.cli
assert "cv2" not in sys.modules or __import__("os").environ["OPENCV_IO_MAX_IMAGE_PIXELS"]
"""
NO_SETTINGS_AT_IMPORT = """
import os
os.environ["CAMIND_PORT"] = "nonsense"
import service.app, service.cli, service.config
"""
LATE_SCIPY = """
import sys
import service.app, service.cli, service.commands.depth_folder
assert not [name for name in sys.modules if name.split(".")[0] == "scipy"]

import service.calibration.look
from threadpoolctl import threadpool_info
libraries = [library for library in threadpool_info() if library["user_api"] == "blas"]
assert libraries and all(library["num_threads"] == 1 for library in libraries), libraries
"""


def imports_of(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module


def importers(name: str, files: list[Path]) -> list[str]:
    return [
        str(path.relative_to(ROOT)) for path in files if any(each.split(".")[0] == name for each in imports_of(path))
    ]


def run_python(code: str) -> None:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", ["torch", "onnx", "onnxscript", "model_export"])
def test_the_service_imports_nothing_of_training(name: str) -> None:
    assert importers(name, SERVICE) == []


def test_the_service_starts_where_torch_is_absent() -> None:
    run_python(BLOCKED)


def test_nothing_reads_the_settings_at_import() -> None:
    run_python(NO_SETTINGS_AT_IMPORT)


def test_a_start_loads_no_scipy_and_what_comes_late_has_one_thread() -> None:
    run_python(LATE_SCIPY)


@pytest.mark.parametrize("name", ["onnxruntime", "cv2", "scipy"])
def test_one_module_alone_imports(name: str) -> None:
    assert len(importers(name, SERVICE)) == 1


@pytest.mark.parametrize("name", ["cv2", "scipy", "fastapi", "pydantic", "sqlmodel"])
def test_the_physics_imports_at_most_numpy(name: str) -> None:
    assert importers(name, OPTICS) == []


def test_formulas_serve_every_array_library() -> None:
    assert importers("numpy", OPTICS) == []


def test_no_folder_is_called_after_nothing() -> None:
    names = {part for path in SERVICE for part in path.relative_to(ROOT).with_suffix("").parts}
    assert not names & {"utils", "util", "common", "core", "helpers", "misc"}


def test_the_environment_is_read_in_one_place() -> None:
    readers = [path.name for path in SERVICE if "os.environ" in path.read_text(encoding="utf-8")]
    assert set(readers) <= {"__init__.py", "config.py"}
