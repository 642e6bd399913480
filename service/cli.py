"""The command ``camind``. Further commands come from packages that register in ``camind.commands``."""

import io
import sys
from importlib.metadata import EntryPoint, entry_points, version

import typer

from service.commands import calibration, calibrations, cameras, database, depth, keys, serve
from service.commands.opened import settings_with
from service.memory import end_uncollected

GROUP = "camind.commands"

app = typer.Typer(
    help="Metres from one photograph, for any camera.",
    context_settings={"help_option_names": ["--help", "-h"], "max_content_width": 120},
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
for single in (serve, database, calibration, depth):
    app.registered_commands += single.app.registered_commands
app.add_typer(cameras.app, name="cameras")
app.add_typer(calibrations.app, name="calibrations")
app.add_typer(keys.app, name="keys")


def main() -> None:
    """Run the command line; other packages' commands are loaded only where one may be meant."""
    own = {command.name or getattr(command.callback, "__name__", "") for command in app.registered_commands}
    wanted = sys.argv[1] if len(sys.argv) > 1 else "--help"
    own |= {group.name for group in app.registered_groups}
    if wanted not in own:
        for entry_point in entry_points(group=GROUP):
            _add_commands(entry_point)
    end_uncollected()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # of a terminal that has not all letters
    app()


@app.command()
def openapi() -> None:
    """Print the API's description (OpenAPI, YAML)."""
    from service.api.openapi import to_yaml
    from service.app import create_app

    typer.echo(to_yaml(create_app(settings_with()).openapi()), nl=False)


@app.command(name="version")
def print_version() -> None:
    """Print the version."""
    typer.echo(version("camind"))


def _add_commands(entry_point: EntryPoint) -> None:
    try:
        commands = entry_point.load()
    except ImportError as exc:
        hint = f"{exc}; pip install 'camind[train]' brings what it needs"
        typer.echo(f"The commands of {entry_point.name} are not available: {hint}.", err=True)
        return
    if not isinstance(commands, typer.Typer):
        raise TypeError(f"{entry_point.value} in {GROUP} is no typer.Typer")
    app.registered_commands += commands.registered_commands
    app.registered_groups += commands.registered_groups
