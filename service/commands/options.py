"""Options that several commands have."""

from typing import Annotated

import typer

MOST_DAYS = 36_500.0  # the calendar has an end

Owner = Annotated[str, typer.Option(help="Whose they are. [default: whoever uses the service without a key]")]
