"""How a command fails: what an operator can mend is a message and an exit code, not a traceback."""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import typer
from sqlalchemy.exc import SQLAlchemyError

from service.config import SettingsError
from service.errors import CamindError

WRONG_USE = 2


def failure(message: str, code: int = 1) -> typer.Exit:
    """Say what is wrong; the exit to raise."""
    typer.echo(message, err=True)
    return typer.Exit(code)


@contextmanager
def plain_failures(code: int = 1) -> Iterator[None]:
    """Around what may fail by what an operator can mend: the database, the disk, the model, a setting."""
    from service.inference.artifact import ModelFolderError

    try:
        yield
    except SQLAlchemyError as exc:
        if isinstance(exc.__context__, SystemExit):
            raise exc.__context__ from None  # a signal came amid a statement, which is not the database's fault
        raise failure(f"The database cannot be used: {_reason(exc)}", code) from exc
    except BrokenPipeError:
        raise  # whoever read what is printed has enough
    except UnicodeEncodeError as exc:
        raise failure(f"{ascii(exc.object)[:80]} is no text: its bytes are no UTF-8.", WRONG_USE) from exc
    except (CamindError, ModelFolderError, SettingsError, OSError) as exc:
        cause = exc.__cause__ if isinstance(exc, CamindError) and exc.status >= 500 else None
        raise failure(f"{exc}\n{_reason(cause)}" if cause else str(exc), code) from exc


def _reason(cause: BaseException) -> str:
    """What a library says went wrong, in one line and without the statement it was at."""
    return " ".join(str(cause.args[0] if cause.args else cause).split())


def end_in_order(code: int | None = None) -> None:
    """Let signals that would end the process at once end it as an error does, with ``code`` or as a shell tells it.

    No half of a database is left behind; and a container's first process is not told of signals it has no handler for.
    """
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, lambda number, _: sys.exit(128 + number if code is None else code))
