"""From an SQLite file to a PostgreSQL database: every row as it is, all of them or none."""

from collections.abc import Callable, Iterator
from pathlib import Path

from sqlalchemy import JSON, URL, Connection, Engine, Table, Text, bindparam, cast, func, insert, select

from service.errors import Conflict
from service.storage import schema
from service.storage.backup import Contents, newest
from service.storage.engine import open_engine, unhurried
from service.storage.tables import metadata

# a calibration's row has 140 kB
ROWS_AT_A_TIME = 100


def move(source: Path, engine: Engine, beside: Path, spool: str | None, tell: Callable[[int, int], None]) -> Contents:
    """Put what an SQLite backup, or the database file itself, holds into an empty PostgreSQL database; what that is.

    A working copy lies beside the file ``beside``, which nobody may use meanwhile; ``tell`` hears how many rows are
    done, of how many. Calibrations that have not ended fail, but for those of the ``spool`` with this id.
    Raises ``DatabaseFileError`` as ``restore`` does, ``NotReady`` where the database is not at the newest schema, and
    ``Conflict`` where it has rows.
    """
    schema.require_head(engine)
    with newest(source, beside, spool) as (draft, contents), engine.connect() as target, unhurried(target):
        _require_empty(target)
        done, total = 0, sum(contents.rows[table.name] for table in metadata.sorted_tables)
        file = open_engine(URL.create("sqlite", database=str(draft)))
        try:
            with file.connect() as rows:
                for table in metadata.sorted_tables:
                    for count in _copying(table, rows, target):
                        done += count
                        tell(done, total)
        finally:
            file.dispose()
    return contents


def _require_empty(target: Connection) -> None:
    """Nobody else writes from here to the transaction's end. Raises ``Conflict`` where somebody has."""
    names = ", ".join(table.name for table in metadata.sorted_tables)
    target.exec_driver_sql(f"LOCK TABLE {names} IN EXCLUSIVE MODE")
    counts = {table.name: target.scalar(select(func.count()).select_from(table)) for table in metadata.sorted_tables}
    found = ", ".join(f"{name} {count}" for name, count in counts.items() if count)
    if found:
        raise Conflict(f"The PostgreSQL database has rows ({found}): nothing was changed; restore into an empty one.")


def _copying(table: Table, source: Connection, target: Connection) -> Iterator[int]:
    """Copy a table; how many rows each step was of. JSON stays the text it is."""
    of_json = {column.name: column.type for column in table.c if isinstance(column.type, JSON)}
    texts = [cast(column, Text).label(column.name) if column.name in of_json else column for column in table.c]
    stored = insert(table).values({name: cast(bindparam(name, type_=Text), kind) for name, kind in of_json.items()})
    found = source.execution_options(yield_per=ROWS_AT_A_TIME).execute(select(*texts))
    for part in found.mappings().partitions():
        target.execute(stored, [dict(row) for row in part])
        yield len(part)
    numbered = table.autoincrement_column
    if numbered is not None:
        # its sequence knows nothing of the numbers that came with the rows
        sequence = func.pg_get_serial_sequence(table.name, numbered.name)
        target.execute(select(func.setval(sequence, func.max(numbered))))
