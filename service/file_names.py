"""Names of photographs as the command line shows them."""

import os

from rich.table import Column


def name_column() -> Column:
    """A column of photographs' names, which are never cut short."""
    return Column("photograph", overflow="fold")


def shown(name: str) -> str:
    """A file's name as text, whatever bytes it is of."""
    return os.fsencode(name).decode("utf-8", "replace")
