"""The service image, built without Docker: the same install commands in a scratch folder, then the app from it."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from model_export.started_server import serving

ROOT = Path(__file__).parents[1]
SERVICE = (ROOT / "docker" / "service.Dockerfile").read_text()
FORBIDDEN = {"torch", "onnx", "onnxscript", "pytest", "mypy", "ray"}


def stage(text: str, number: int) -> list[tuple[str, str]]:
    """Instructions of one build stage as (word, rest)."""
    joined = re.sub(r"\\\n\s*", " ", text)
    stages: list[list[tuple[str, str]]] = []
    for line in joined.splitlines():
        word, _, rest = line.partition(" ")
        if word == "FROM":
            stages.append([])
        elif word.isupper():
            stages[-1].append((word, rest))
    return stages[number]


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The venv that the build stage's COPY and RUN lines make, with /src and /opt/camind moved to a scratch folder."""
    scratch = tmp_path_factory.mktemp("image")
    source, venv = scratch / "src", scratch / "camind"
    source.mkdir()
    for word, rest in stage(SERVICE, 0):
        if word == "COPY":
            *names, target = rest.split()
            for name in names:
                place = scratch / target.strip("/")
                copy_into(ROOT / name, place)
        if word == "RUN":
            command = rest.replace("/opt/camind", str(venv)).replace("python3 -m venv", f"{sys.executable} -m venv")
            # bytecode of what no test imports is not worth the time; pip reads this as what `compile` is to be
            environment = {**os.environ, "PIP_NO_COMPILE": "0"}
            subprocess.run(["sh", "-c", command], cwd=source, env=environment, check=True, capture_output=True)
    return venv


def copy_into(source: Path, place: Path) -> None:
    if source.is_dir():
        shutil.copytree(source, place, ignore=shutil.ignore_patterns("__pycache__"))
    else:
        place.mkdir(exist_ok=True)
        shutil.copy(source, place)


def test_the_image_holds_no_training(image: Path) -> None:
    listed = subprocess.run(
        [str(image / "bin" / "python"), "-m", "pip", "list", "--format", "json"], capture_output=True, check=True
    )
    installed = {package["name"].lower() for package in json.loads(listed.stdout)}
    assert not installed & FORBIDDEN
    assert {"onnxruntime", "psycopg", "fastapi"} <= installed


def test_the_app_starts_from_the_image_and_serves_the_shipped_model(image: Path, tmp_path: Path) -> None:
    with serving(tmp_path / "data", camind=image / "bin" / "camind") as server:
        assert server.ask("GET", "/model").json()["manifest"]["kind"] == "compact"
        assert server.ask("GET", "/web/vendor/preact.js").status == 200


def test_training_commands_are_refused_in_plain_words_without_torch(image: Path, tmp_path: Path) -> None:
    command: list[str | Path] = [image / "bin" / "camind", "verify", "--checkpoint", os.devnull]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode != 0
    assert "Traceback" not in done.stderr
    assert "camind[train]" in done.stderr


def test_the_service_runs_as_nobody_in_particular() -> None:
    last = dict(stage(SERVICE, 1))
    assert last["USER"] not in {"root", "0"}
    assert "/health/ready" in last["HEALTHCHECK"]
    assert "read_only: true" in (ROOT / "docker" / "compose.yaml").read_text()


def test_the_images_own_python_is_compiled_while_it_may_be_written() -> None:
    words, commands = zip(*stage(SERVICE, 1), strict=True)
    (compiled,) = (number for number, command in enumerate(commands) if "-m compileall" in command)
    assert compiled < words.index("USER")


def test_health_is_asked_for_at_the_port_that_is_set(tmp_path: Path, tiny_model_dir: Path) -> None:
    command: list[str] = json.loads(dict(stage(SERVICE, 1))["HEALTHCHECK"].partition("CMD ")[2])
    with serving(tmp_path / "data", "--model", tiny_model_dir) as server:
        nobody = "http://127.0.0.1:9"
        environment = {**os.environ, "CAMIND_PORT": str(server.port), "http_proxy": nobody, "no_proxy": ""}
        subprocess.run([sys.executable, *command[1:]], env=environment, check=True)
