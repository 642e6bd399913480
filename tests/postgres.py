"""A scratch PostgreSQL cluster: in a folder of its own, reached through a socket there, gone afterwards."""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

OWNER = "camind"
SETTINGS = "-c listen_addresses='' -c fsync=off -c max_connections=30"


def find_binaries() -> Path | None:
    """The folder of the newest PostgreSQL server on this machine, if there is one."""
    on_path = shutil.which("initdb")
    if on_path:
        return Path(on_path).parent
    installed = sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda path: int(path.parent.name))
    return installed[-1] if installed else None


@contextmanager
def running_cluster(binaries: Path) -> Iterator[str]:
    """The socket's folder of a running cluster; its superuser is ``OWNER`` and needs no password."""
    folder = Path(tempfile.mkdtemp(prefix="camind-pg-"))
    user = _server_user(folder)
    data = folder / "data"

    def run(program: str, *arguments: str) -> None:
        subprocess.run(
            [binaries / program, "-D", data, *arguments], check=True, cwd=folder, stdout=subprocess.DEVNULL, **user
        )

    try:
        run("initdb", "-A", "trust", "-U", OWNER, "-E", "UTF8", "--locale=C.UTF-8", "--no-sync")
        run("pg_ctl", "-w", "-l", str(folder / "log"), "-o", f"-k {folder} {SETTINGS}", "start")
        try:
            yield str(folder)
        finally:
            run("pg_ctl", "-w", "-m", "immediate", "stop")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def database_url(socket_folder: str, database: str) -> str:
    """The URL of a database of the cluster."""
    return f"postgresql+psycopg://{OWNER}@/{database}?host={quote(socket_folder, safe='')}"


def _server_user(folder: Path) -> dict[str, Any]:
    # the server refuses to run as root
    if os.geteuid() != 0:
        return {}
    shutil.chown(folder, "nobody")
    return {"user": "nobody", "extra_groups": []}
