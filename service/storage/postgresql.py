"""PostgreSQL's side of the engine: whatever the server does, a request ends; psycopg itself would wait for ever."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import psycopg
from psycopg.abc import PQGen
from psycopg.pq import TransactionStatus
from sqlalchemy import URL, Connection, Dialect, Engine, ExceptionContext, event
from sqlalchemy.pool import ConnectionPoolEntry

from service.storage.engine import POSTGRESQL_READ_ONLY

LOCK_TIMEOUT_MS = 5_000
STATEMENT_TIMEOUT_MS = 8_000
# the server's own limits come first; this one is for a server that stands still
ANSWER_TIMEOUT_S = 10.0
CONNECT = {
    # a server that was set up without a locale says SQL_ASCII, for which psycopg gives bytes
    "client_encoding": "utf8",
    "connect_timeout": 5,
    "tcp_user_timeout": 10_000,
    "keepalives_idle": 5,
    "keepalives_interval": 2,
    "keepalives_count": 3,
}
LOOK_S = 0.1
T = TypeVar("T")


class BoundedConnection(psycopg.Connection[Any]):
    """A connection that is closed, with ``OperationalError``, where the server answers nothing for too long."""

    answer_timeout_s: float | None = None

    def wait(self, gen: PQGen[T], interval: float = LOOK_S, timeout: float | None = None) -> T:
        """As the base class does; without a time of its own the connection's holds."""
        try:
            return super().wait(gen, interval, self.answer_timeout_s if timeout is None else timeout)
        except psycopg.OperationalError:
            if self.pgconn.transaction_status == TransactionStatus.ACTIVE:
                # the answer may still come, to whatever is asked next
                self.close()
            raise


def connect_args(url: URL) -> dict[str, Any]:
    """What psycopg is told beside the URL, whose own parameters win."""
    # psycopg reads dates of no other style
    told = f"-c lock_timeout={LOCK_TIMEOUT_MS} -c statement_timeout={STATEMENT_TIMEOUT_MS} -c datestyle=ISO"
    given = url.query.get("options", "")
    options = " ".join([told, *([given] if isinstance(given, str) else given)])
    return {**{name: value for name, value in CONNECT.items() if name not in url.query}, "options": options}


def bound(engine: Engine) -> None:
    """Let the engine make ``BoundedConnection``s, and new ones where those there are take no writes."""
    event.listen(engine, "do_connect", _connect)
    event.listen(engine, "handle_error", _leave_read_only)


@contextmanager
def unhurried(connection: Connection) -> Iterator[None]:
    """A transaction without limits of time, which is committed at its end."""
    driver = connection.connection.driver_connection
    if not isinstance(driver, BoundedConnection):
        raise TypeError("the engine was not made by open_engine")
    driver.answer_timeout_s = None
    try:
        with connection.begin():
            connection.exec_driver_sql("SET LOCAL lock_timeout = 0")
            connection.exec_driver_sql("SET LOCAL statement_timeout = 0")
            yield
    finally:
        driver.answer_timeout_s = ANSWER_TIMEOUT_S


def _connect(
    _dialect: Dialect, _entry: ConnectionPoolEntry, arguments: list[Any], parameters: dict[str, Any]
) -> BoundedConnection:
    connection = BoundedConnection.connect(*arguments, **parameters)
    connection.answer_timeout_s = ANSWER_TIMEOUT_S
    return connection


def _leave_read_only(context: ExceptionContext) -> None:
    # a session stays what it began as, though its server has become the one that takes writes, or another one has
    if getattr(context.original_exception, "sqlstate", None) == POSTGRESQL_READ_ONLY:
        context.is_disconnect = True
