"""What is installed is locked with hashes, the lock is what pyproject.toml asks for, and the audit tells the truth."""

import json
import os
import re
import shutil
import subprocess
import sys
import threading
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).parents[1]
LOCKS = ROOT / "requirements"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
EXTRAS = PROJECT["project"]["optional-dependencies"]
SERVED_EXTRAS = {"postgres", "otel", "heic", "raw"}
SERVED = PROJECT["project"]["dependencies"] + [wanted for extra in SERVED_EXTRAS for wanted in EXTRAS[extra]]
DEVELOPED = SERVED + EXTRAS["train"] + PROJECT["dependency-groups"]["dev"]
# its builds, and so its hashes, differ by platform
UNLOCKED = {"torch"}
# extras that neither the image nor development installs
OPTIONAL = {"cluster"}
PIN = re.compile(r"([\w.-]+)==(\S+)(?: ; ([^\\]+?))? \\\n((?:    --hash=sha256:[0-9a-f]{64}(?: \\)?\n)+)")


def text(lock: str) -> str:
    """A lock without its comments."""
    return re.sub(r"^#.*\n", "", (LOCKS / lock).read_text(), flags=re.MULTILINE)


def pins(lock: str) -> dict[str, set[Version]]:
    """Every version that a lock pins, for there may be one for each Python."""
    found: dict[str, set[Version]] = {}
    for name, version, _, _ in PIN.findall(text(lock)):
        found.setdefault(canonicalize_name(name), set()).add(Version(version))
    return found


@pytest.mark.parametrize("lock", ["pip.txt", "service.txt", "dev.txt", "build.txt"])
def test_a_lock_is_pins_with_hashes_and_nothing_else(lock: str) -> None:
    assert PIN.sub("", text(lock)) == ""
    assert "make lock" in (LOCKS / lock).read_text()


@pytest.mark.parametrize(
    ("lock", "wanted"),
    [
        ("service.txt", SERVED),
        ("dev.txt", DEVELOPED),
        ("build.txt", PROJECT["build-system"]["requires"]),
    ],
)
def test_a_lock_satisfies_pyproject(lock: str, wanted: list[str]) -> None:
    locked = pins(lock)
    for requirement in map(Requirement, wanted):
        if requirement.name not in UNLOCKED:
            versions = locked.get(canonicalize_name(requirement.name), set())
            assert versions, f"{requirement} is not in {lock}: run `make lock`"
            assert all(requirement.specifier.contains(version) for version in versions), f"{requirement}: `make lock`"


def test_every_extra_is_locked_or_known_not_to_be() -> None:
    assert set(EXTRAS) == {"train"} | SERVED_EXTRAS | OPTIONAL


def test_development_has_what_the_service_has() -> None:
    developed = pins("dev.txt")
    assert {name: developed[name] for name in pins("service.txt")} == pins("service.txt")
    assert not set(pins("service.txt")) & {"torch", "onnx", "pytest"}


def test_what_installs_the_service_is_part_of_it() -> None:
    assert pins("pip.txt") == {"pip": pins("service.txt")["pip"]}


def test_the_wheel_names_the_licence_of_what_it_brings_along() -> None:
    shipped = {path.relative_to(ROOT).as_posix() for path in (ROOT / "service").rglob("licences.txt")}
    assert set(PROJECT["project"]["license-files"]) == {"LICENSE"} | shipped
    assert PROJECT["project"]["license"] == "Apache-2.0 AND MIT"


def test_what_checks_the_page_is_locked_with_hashes() -> None:
    wanted = json.loads((ROOT / "package.json").read_text())
    packages: dict[str, dict[str, str]] = json.loads((ROOT / "package-lock.json").read_text())["packages"]
    ourselves = packages.pop("")
    assert ourselves["devDependencies"] == wanted["devDependencies"], "run `make lock`"
    assert {f"node_modules/{name}" for name in wanted["devDependencies"]} <= set(packages)
    # a host belongs to whoever installs
    assert all(package["integrity"] and "resolved" not in package for package in packages.values())


def test_everything_that_installs_asks_for_hashes() -> None:
    for place in (ROOT / "docker" / "service.Dockerfile", ROOT / "Makefile"):
        installs = [line for line in place.read_text().splitlines() if re.search(r"pip install|PIP\) install", line)]
        assert installs
        for line in installs:
            is_hashed = "--require-hashes" in line or ("--no-deps" in line and "--build-constraint" in line)
            assert is_hashed or "torch==" in line, line
    assert "$(NPM) ci " in (ROOT / "Makefile").read_text()


TELL = 'test "$1" = -c || { echo "$@"; exit 1; }'


def script(file: Path, words: str) -> None:
    file.write_text(f"#!/bin/sh\n{words}\n")
    file.chmod(0o755)


def set_up(folder: Path, python: str) -> subprocess.CompletedProcess[str]:
    """Setting up in a folder where a failed attempt left a .venv without pip, by what stands for Python."""
    shutil.copy(ROOT / "Makefile", folder)
    shutil.copy(ROOT / "pyproject.toml", folder)
    shutil.copytree(LOCKS, folder / "requirements")
    (folder / ".venv" / "bin").mkdir(parents=True, exist_ok=True)
    script(folder / ".venv" / "bin" / "python", TELL)
    script(folder / "python", python)
    command = ["make", ".venv/.service", "PYTHON=./python"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_an_environment_that_has_no_pip_is_made_anew(tmp_path: Path) -> None:
    done = set_up(tmp_path, TELL)
    assert "-m venv --clear .venv" in done.stdout


@pytest.mark.parametrize(("made_in", "is_made_anew"), [("elsewhere", True), ("Zoë's camera", False)])
def test_an_environment_that_was_moved_is_made_anew(tmp_path: Path, made_in: str, is_made_anew: bool) -> None:
    folder = tmp_path / "Zoë's camera"
    programs = folder / ".venv" / "bin"
    programs.mkdir(parents=True)
    script(programs / "pip", TELL)
    script(programs / "camind", f"exec '{tmp_path}/{made_in}/.venv/bin/python'")
    (folder / ".venv" / ".service").touch()
    os.utime(folder / ".venv" / ".service", (2**32, 2**32))
    done = set_up(folder, TELL)
    assert ("-m venv --clear .venv" in done.stdout) == is_made_anew
    assert ("is up to date" in done.stdout) != is_made_anew


@pytest.mark.parametrize("version", [(3, 10, 13), (3, 15, 0)])
def test_a_python_too_old_or_too_new_is_said_before_anything_is_made(
    tmp_path: Path, version: tuple[int, int, int]
) -> None:
    other = f"import sys; sys.version_info = {version}; exec(sys.argv[1])"
    done = set_up(tmp_path, f"exec {sys.executable} -c '{other}' \"$2\"")
    assert done.returncode != 0
    assert "\nPython 3.11 to 3.14: " in done.stderr


def test_the_bill_of_materials_names_every_pin(tmp_path: Path) -> None:
    out = tmp_path / "sbom.json"
    command = ["make", "--no-print-directory", "--dry-run", "--always-make", "sbom"]
    planned = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    words = re.sub(r"\\\n", " ", planned).partition("cyclonedx-py ")[2].split()
    words[words.index("dist/sbom.json")] = str(out)
    program = Path(sys.executable).parent / "cyclonedx-py"
    subprocess.run([program, *words], cwd=ROOT, check=True, capture_output=True)
    components = json.loads(out.read_text())["components"]
    assert {canonicalize_name(component["name"]) for component in components} == set(pins("service.txt"))


def audited(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(LOCKS / "audit.py"), "-s", "osv", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@contextmanager
def database(vulnerable: str) -> Iterator[str]:
    """A database of vulnerabilities that knows one, of the package of this name; its URL."""

    class Answers(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            asked = json.loads(self.rfile.read(int(self.headers["Content-Length"])))["package"]
            affected = {"package": asked, "ranges": [{"type": "ECOSYSTEM", "events": [{"fixed": "99.0"}]}]}
            known = [{"id": "CVE-2026-0001", "summary": "bad", "affected": [affected]}]
            body = json.dumps({"vulns": known} if asked["name"] == vulnerable else {}).encode()
            self.send_response(200)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Answers) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/v1/query"
        server.shutdown()
        thread.join()


def test_a_known_vulnerability_fails_the_audit() -> None:
    with database("starlette") as url:
        done = audited("--osv-url", url)
    assert done.returncode == 1
    assert "VULNERABLE: starlette" in done.stdout
    assert "mended in 99.0" in done.stdout


def test_a_lock_without_any_passes_and_says_how_much_was_looked_up() -> None:
    with database("none of ours") as url:
        done = audited("--strict", "--osv-url", url)
    assert done.returncode == 0, done.stderr
    looked_up, of = map(int, re.findall(r"(\d+) of (\d+) packages looked up: 0 ", done.stdout)[0])
    assert looked_up == of > 100


@pytest.mark.parametrize(("arguments", "code"), [((), 0), (("--strict",), 2)])
def test_a_database_out_of_reach_is_said_aloud(arguments: tuple[str, ...], code: int) -> None:
    done = audited("--osv-url", "http://127.0.0.1:1/v1/query", *arguments)
    assert done.returncode == code
    assert "NOT AUDITED" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_wrong_call_is_no_unreachable_database() -> None:
    done = audited("--nonsense")
    assert done.returncode == 2
    assert "NOT AUDITED" not in done.stderr
