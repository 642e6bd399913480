"""Alembic's entry: on the connection it is handed, or, from its own command line, on the configured one."""

from alembic import context
from sqlalchemy import Connection

from service.config import load_storage_settings
from service.storage.engine import open_engine, unhurried
from service.storage.tables import metadata


def run(connection: Connection) -> None:
    """Run the steps in one transaction. Batch mode, because SQLite can alter little in place."""
    context.configure(
        connection=connection,
        target_metadata=metadata,
        render_as_batch=True,
        transactional_ddl=True,
    )
    with context.begin_transaction():
        context.run_migrations()


def main() -> None:
    """Take the caller's connection where there is one."""
    given = context.config.attributes.get("connection")
    if isinstance(given, Connection):
        run(given)
        return
    with open_engine(load_storage_settings().effective_database_url).connect() as connection, unhurried(connection):
        run(connection)


main()
