"""The service image, built without Docker: the same install commands in a scratch folder, then the app from it."""

import json
import os
import re
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

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
            subprocess.run(command, shell=True, cwd=source, check=True, capture_output=True)  # noqa: S602 # the Dockerfile's own words
    return venv


def copy_into(source: Path, place: Path) -> None:
    if source.is_dir():
        shutil.copytree(source, place, ignore=shutil.ignore_patterns("__pycache__"))
    else:
        place.mkdir(exist_ok=True)
        shutil.copy(source, place)


def environment(data: Path) -> dict[str, str]:
    return {"PATH": "/usr/bin:/bin", "CAMIND_DATA_DIR": str(data), "HOME": str(data), "LANG": "C.UTF-8"}


@pytest.fixture(scope="module")
def port(image: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """The app started from the image's venv, away from the checkout."""
    data = tmp_path_factory.mktemp("data")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        number = int(probe.getsockname()[1])
    command = [str(image / "bin" / "camind"), "serve", "--port", str(number)]
    with (data / "log").open("w") as log:
        process = subprocess.Popen(command, cwd=data, env=environment(data), stdout=log, stderr=log)
    try:
        wait_until_ready(number, process, data / "log")
        yield number
    finally:
        process.terminate()
        process.wait(20)


def wait_until_ready(port: int, process: "subprocess.Popen[bytes]", log: Path) -> None:
    for _ in range(300):
        if process.poll() is not None:
            pytest.fail(f"the service ended: {log.read_text()}")
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/health/ready", timeout=2) as answer:
                assert answer.status == 200
                return
        except OSError:
            time.sleep(0.2)
    pytest.fail(f"not ready after a minute: {log.read_text()}")


def test_the_image_holds_no_training(image: Path) -> None:
    listed = subprocess.run(
        [str(image / "bin" / "python"), "-m", "pip", "list", "--format", "json"], capture_output=True, check=True
    )
    installed = {package["name"].lower() for package in json.loads(listed.stdout)}
    assert not installed & FORBIDDEN
    assert {"onnxruntime", "psycopg", "fastapi"} <= installed


def test_the_app_starts_from_the_image_and_serves_the_shipped_model(port: int) -> None:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/model", timeout=5) as answer:
        assert json.load(answer)["manifest"]["kind"] == "compact"


def test_training_commands_are_refused_in_plain_words_without_torch(image: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [str(image / "bin" / "camind"), "verify", "--checkpoint", os.devnull],
        env=environment(tmp_path),
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode != 0
    assert "Traceback" not in done.stderr
    assert "train" in done.stderr


def test_the_service_runs_as_nobody_in_particular() -> None:
    last = dict(stage(SERVICE, 1))
    assert last["USER"] not in {"root", "0"}
    assert "/health/ready" in last["HEALTHCHECK"]
    assert "read_only: true" in (ROOT / "docker" / "compose.yaml").read_text()
