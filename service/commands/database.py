"""``camind migrate``, ``backup`` and ``restore``: the database as a whole."""

from pathlib import Path
from typing import Annotated

import typer

from service.commands.failures import WRONG_USE, end_in_order, failure, plain_failures
from service.commands.opened import opened, ready_engine, storage_settings
from service.config import DATABASE_FILE, StorageSettings

app = typer.Typer()


@app.command()
def migrate() -> None:
    """Bring the database to the newest schema."""
    from service.storage import schema

    with plain_failures(), opened(storage_settings(), is_migrated=True) as engine:
        typer.echo(f"The database is at {schema.current_revision(engine)}.")


@app.command(name="backup")
def back_up(
    file: Annotated[Path, typer.Argument(help="File to write", dir_okay=False)],
    force: Annotated[bool, typer.Option("--force", help="Overwrite it if it is there")] = False,
) -> None:
    """Copy the SQLite database to a file, whole and checked; a service may go on using it.

    Photographs that wait to be calibrated are not in it.
    """
    from service.storage.backup import backup, database_file

    end_in_order()
    database = database_file(storage_settings().effective_database_url)
    if database is None:
        raise failure("Only an SQLite file is backed up here: use pg_dump and pg_restore for PostgreSQL.", WRONG_USE)
    with plain_failures():
        contents = backup(database, file, is_forced=force)
    typer.echo(f"{file} holds {contents}")


@app.command()
def restore(
    file: Annotated[Path, typer.Argument(help="What `camind backup` wrote", dir_okay=False)],
) -> None:
    """Put a backup in the SQLite database's place, at the newest schema; no service may use it meanwhile.

    The database that was there is kept beside it under a dated name. Where CAMIND_DATABASE_URL is an empty PostgreSQL
    database, after `camind migrate`, the backup's rows go there: that is how to change from SQLite; what pg_dump wrote
    is for pg_restore. Calibrations whose photographs are in another data folder than this one fail.
    """
    from service.storage.backup import database_file
    from service.storage.backup import restore as put_back
    from service.storage.spool import known_id

    end_in_order()
    settings = storage_settings()
    database = database_file(settings.effective_database_url)
    with plain_failures():
        if database is None:
            _move(file, settings)
            return
        contents, kept = put_back(file, database, known_id(settings.spool_dir))
    typer.echo(f"{database} holds {contents}")
    if kept is not None:
        typer.echo(f"What was there before is {kept}")


def _move(file: Path, settings: StorageSettings) -> None:
    from service.storage.move import move
    from service.storage.spool import known_id

    def tell(done: int, total: int) -> None:
        typer.echo(f"\r{done} of {total} rows", nl=done == total, err=True)

    with ready_engine() as engine:
        contents = move(file, engine, settings.data_dir.resolve() / DATABASE_FILE, known_id(settings.spool_dir), tell)
    typer.echo(f"The PostgreSQL database holds {contents}")
