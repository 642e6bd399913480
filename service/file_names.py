"""Photographs as the command line shows them: their names, and tables of them."""

import os

from rich.console import Console
from rich.table import Column, Table

FILE_COLUMNS = 10_000


def name_column() -> Column:
    """A column of photographs' names, which are never cut short."""
    return Column("photograph", overflow="fold")


def shown(name: str) -> str:
    """A file's name as text, whatever bytes it is of."""
    return os.fsencode(name).decode("utf-8", "replace")


def print_table(table: Table) -> None:
    """To the terminal at its width; to a file a photograph a line, whatever is said of it."""
    console = Console(markup=False, emoji=False)  # a file's name is no markup
    if not console.is_terminal:
        console.width = FILE_COLUMNS
    console.print(table)
