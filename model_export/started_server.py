"""A started ``camind serve``: the real command in a process of its own."""

import http.client
import json
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

CAMIND = Path(sys.executable).parent / "camind"
START_S = 60
ANSWER_S = 300
T = TypeVar("T")
Body = bytes | str | Iterable[bytes] | None


@dataclass(frozen=True, slots=True)
class Reply:
    """A whole answer; header names in lower case."""

    status: int
    headers: dict[str, str]
    body: bytes

    def json(self) -> dict[str, Any]:
        content: dict[str, Any] = json.loads(self.body)
        return content


def ask_over(
    connection: http.client.HTTPConnection,
    method: str,
    path: str,
    body: Body = None,
    headers: dict[str, str] | None = None,
) -> Reply:
    """One request over a connection that stays open."""
    connection.request(method, path, body, headers or {})
    answer = connection.getresponse()
    found = {name.lower(): value for name, value in answer.getheaders()}
    return Reply(answer.status, found, answer.read())


class Server:
    """A service on a port the system chose; its log lies beside its data folder."""

    def __init__(self, data_dir: Path, arguments: tuple[str | Path, ...], camind: Path, settings: Mapping[str, str]):
        environment = {**os.environ, "CAMIND_DATA_DIR": str(data_dir), "CAMIND_LOG_FORMAT": "json", **settings}
        self._log = data_dir.parent / "server.log"
        command: list[str | Path] = [camind, "serve", "--port", "0", *arguments]
        with self._log.open("w") as log:
            # away from the checkout, whose packages would hide those of another installation
            self.process = subprocess.Popen(command, env=environment, stderr=log, cwd=data_dir.parent)
        self.port = 0

    def wait_until_ready(self) -> None:
        self.port = self._wait_for_port()
        self.poll(lambda: self.ask("GET", "/health/ready").status == 200)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/"

    @property
    def log(self) -> str:
        return self._log.read_text()

    @property
    def peak_memory_bytes(self) -> int:
        """The most physical memory the process has held."""
        return self._memory_bytes("VmHWM")

    @property
    def memory_bytes(self) -> int:
        """The physical memory the process holds now."""
        return self._memory_bytes("VmRSS")

    def _memory_bytes(self, what: str) -> int:
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(re.findall(rf"{what}:\s+(\d+) kB", status)[0]) * 1024

    def connect(self) -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.port), timeout=10)

    def ask(self, method: str, path: str, body: Body = None, headers: dict[str, str] | None = None) -> Reply:
        """One request over a connection of its own."""
        with closing(self.keep_connection()) as connection:
            return ask_over(connection, method, path, body, headers)

    def keep_connection(self) -> http.client.HTTPConnection:
        """A connection for one request after the other, to be closed."""
        return http.client.HTTPConnection("127.0.0.1", self.port, timeout=ANSWER_S)

    def add(self, camera: Mapping[str, Any]) -> int:
        """Register a camera; the status."""
        return self.ask("POST", "/cameras", json.dumps(camera), {"Content-Type": "application/json"}).status

    def stop(self, number: int) -> int:
        self.process.send_signal(number)
        return self.process.wait(timeout=30)

    def _wait_for_port(self) -> int:
        def find() -> int | None:
            found = re.search(r"camind on http://127\.0\.0\.1:(\d+)", self.log)
            return int(found[1]) if found else None

        return self.poll(find)

    def poll(self, look: Callable[[], T | None]) -> T:
        give_up = time.monotonic() + START_S
        while time.monotonic() < give_up:
            if self.process.poll() is not None:
                raise RuntimeError(f"the service has ended:\n{self.log}")
            found = look()
            if found:
                return found
            time.sleep(0.05)
        raise TimeoutError(f"not seen within {START_S} s:\n{self.log}")


@contextmanager
def serving(
    data_dir: Path, *arguments: str | Path, camind: Path = CAMIND, settings: Mapping[str, str] | None = None
) -> Iterator[Server]:
    """A server for a while; killed at the end if it still runs."""
    server = Server(data_dir, arguments, camind, settings or {})
    try:
        server.wait_until_ready()
        yield server
    finally:
        if server.process.poll() is None:
            server.process.kill()
            server.process.wait()
