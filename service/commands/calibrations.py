"""``camind calibrations``: those in the database."""

from datetime import UTC, datetime, timedelta
from typing import Annotated

import typer

from service.commands.opened import ready_engine
from service.commands.options import MOST_DAYS

app = typer.Typer(help="The calibrations in the database.", no_args_is_help=True)


@app.command(name="prune")
def prune_calibrations(
    days: Annotated[float, typer.Option(help="How long what has ended is kept", min=1.0, max=MOST_DAYS)],
) -> None:
    """Delete, of every owner, what ended longer ago than that. The cameras that came of it stay."""
    from service.storage.calibrations import Calibrations

    with ready_engine() as engine:
        count = Calibrations(engine).forget(datetime.now(UTC) - timedelta(days=days))
    typer.echo(f"deleted calibrations: {count}")
