"""What commands show: the bar of long work, tables, and files' names."""

import os

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Column, Table

FILE_COLUMNS = 10_000


def progress_bar(console: Console | None = None) -> Progress:
    """What is done, of how much, since when and until when; on standard error, if nowhere else."""
    counted = BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn()
    columns = (TextColumn("{task.description}"), *counted)
    return Progress(*columns, console=console or Console(stderr=True), speed_estimate_period=300)


def name_column() -> Column:
    """A column of photographs' names, which are never cut short."""
    return Column("photograph", overflow="fold")


def shown(name: str) -> str:
    """A file's name as text, whatever bytes it is of."""
    return os.fsencode(name).decode("utf-8", "replace")


def print_table(table: Table) -> None:
    """To the terminal at its width; to a file each row in a line, whatever is said in it."""
    console = Console(markup=False, emoji=False)  # a file's name is no markup
    if not console.is_terminal:
        console.width = FILE_COLUMNS
    console.print(table)
