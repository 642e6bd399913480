"""``camind serve``: the service, until it is stopped."""

import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer
from sqlalchemy import Engine

from service.commands.cameras import store_seeds
from service.commands.failures import WRONG_USE, end_in_order, failure, plain_failures
from service.commands.opened import opened, settings_with
from service.config import Settings, StorageSettings
from service.errors import CamindError
from service.memory import lasting
from service.principal import LOCAL

app = typer.Typer()


@app.command()
def serve(
    host: Annotated[str | None, typer.Option(help="Address to bind. [default: 127.0.0.1]")] = None,
    port: Annotated[int | None, typer.Option(help="TCP port, 0 for any. [default: 8000]")] = None,
    model: Annotated[Path | None, typer.Option(help="Model folder. [default: the shipped model]")] = None,
    seed: Annotated[bool, typer.Option("--seed", help="Give a database that never had a camera the paper's")] = False,
) -> None:
    """Answer requests until stopped. Everything else is set by CAMIND_* variables.

    Exit codes: 0 after SIGTERM, SIGINT or SIGHUP, once what was asked is answered; 143, 130 or 129 where a second one
    did not wait for that; 1 where it cannot start (the address, the model, the database); 2 for a wrong setting.
    """
    end_in_order(0)
    settings = settings_with(host=host, port=port, model_dir=model)
    with lasting():
        from service import logs, server
        from service.app import create_app
        from service.inference.artifact import load_model_folder
        from service.storage.cameras import has_had_cameras
        from service.storage.spool import Spool

    logs.configure(settings.log_level, settings.log_format)
    with plain_failures():
        listener = server.bind(settings.host, settings.port)
        load_model_folder(settings.served_model_dir)
        served = create_app(settings)
        _require_sound(settings)
        with opened(settings) as engine:
            if seed and settings.is_database_embedded and not has_had_cameras(engine):
                store_seeds(engine, LOCAL)
            if settings.wants_keys:
                require_key(settings, engine)
        Spool(settings.spool_dir)
    address = f"[{settings.host}]" if ":" in settings.host else settings.host
    with suppress(OSError):  # a log's full disk is no reason not to serve
        typer.echo(f"camind on http://{address}:{listener.getsockname()[1]}", err=True)
        if not (settings.is_loopback or settings.wants_keys):
            typer.echo("Other machines can reach it, and it asks nobody who they are.", err=True)
    has_served = server.serve(served, settings, listener)
    _drop_unwritten()
    if not has_served:
        raise failure("camind did not start: the log above says why.")


def _require_sound(settings: StorageSettings) -> None:
    from service.storage.backup import database_file, require_sound, using

    database = database_file(settings.effective_database_url)
    if database is not None:
        with using(settings.effective_database_url):
            require_sound(database)


def require_key(settings: Settings, engine: Engine) -> None:
    """Where requests need a key there is a good one, or it is said how to make one."""
    from service.storage import schema
    from service.storage.keys import Keys

    try:
        has_key = Keys(engine).has_good()
    except CamindError:
        schema.require_head(engine)  # which says it better
        raise
    if not has_key:
        raise failure(
            f"Requests to {settings.host} need an API key, and there is none: make one with `camind keys create NAME`, "
            "or set CAMIND_API_KEYS=off to let everybody in.",
            WRONG_USE,
        )


def _drop_unwritten() -> None:
    """Let the log's last lines go where there is no room for them: Python would end as if the service had failed."""
    try:
        sys.stderr.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())
