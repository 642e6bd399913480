"""The schema's version: where a database stands, where it should stand, and the way there."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, Engine

import migrations
from service.errors import NotReady
from service.storage.engine import IS_WRITE, reading, unhurried

BASE = "base"
HEAD = "head"
VERSION_TABLE = "alembic_version"
# any number, the same in every process that migrates
LOCK = 0x63616D696E64


@cache
def head_revision() -> str | None:
    """The newest migration this code knows: those of a later version may be installed while it runs."""
    return ScriptDirectory.from_config(_config()).get_current_head()


def known_revisions() -> set[str]:
    """Every migration this code knows."""
    return {script.revision for script in ScriptDirectory.from_config(_config()).walk_revisions()}


def current_revision(engine: Engine) -> str | None:
    """The last migration that ran on the database; ``None`` where none did."""
    with reading(engine) as session:
        return MigrationContext.configure(session.connection()).get_current_revision()


def require_head(engine: Engine) -> None:
    """Raise ``NotReady`` where the database is not at the newest migration."""
    current, head = current_revision(engine), head_revision()
    if current != head:
        _require_known(current)
        found = f"is at schema {current}, not at {head}" if current else "has no tables yet"
        raise NotReady(f"The database {found}: run `camind migrate`.")


def upgrade(engine: Engine, revision: str = HEAD) -> None:
    """Bring the database forward: all steps or none, and never two processes at once.

    Raises ``NotReady`` where a later version has migrated it.
    """
    _require_known(current_revision(engine))
    with _migrating(engine) as connection:
        command.upgrade(_config(connection), revision)


def downgrade(engine: Engine, revision: str = BASE) -> None:
    """Take the database back; what the later schema alone could hold is lost."""
    with _migrating(engine) as connection:
        command.downgrade(_config(connection), revision)


def _require_known(revision: str | None) -> None:
    if revision is not None and revision not in known_revisions():
        raise NotReady(
            f"The database is at schema {revision}, which this version does not know: "
            "install the version that made it, or restore a backup."
        )


def _config(connection: Connection | None = None) -> Config:
    config = Config(attributes={"connection": connection})
    config.set_main_option("script_location", str(Path(migrations.__file__).parent).replace("%", "%%"))
    return config


@contextmanager
def _migrating(engine: Engine) -> Iterator[Connection]:
    is_sqlite = engine.dialect.name == "sqlite"
    with engine.execution_options(**{IS_WRITE: True}).connect() as connection:
        if is_sqlite:
            # a rebuilt table drops the old one, which foreign keys forbid; the setting works outside of
            # transactions only
            _run_outside_transaction(connection, "PRAGMA foreign_keys = OFF")
        try:
            with unhurried(connection):
                if engine.dialect.name == "postgresql":
                    connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({LOCK})")
                yield connection
        finally:
            if is_sqlite:
                _run_outside_transaction(connection, "PRAGMA foreign_keys = ON")


def _run_outside_transaction(connection: Connection, statement: str) -> None:
    cursor = connection.connection.cursor()
    cursor.execute(statement)
    cursor.close()
