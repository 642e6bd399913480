"""What tables on the command line show of photographs."""

import os

from rich.table import Column


def photographs() -> Column:
    """A column of their names, which are never cut short."""
    return Column("photograph", overflow="fold")


def shown(name: str) -> str:
    """A file's name as text, whatever bytes it is of."""
    return os.fsencode(name).decode("utf-8", "replace")
