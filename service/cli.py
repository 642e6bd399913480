"""The command ``camind``. Further commands come from packages that register in ``camind.commands``."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import EntryPoint, entry_points, version
from pathlib import Path
from typing import Annotated, Literal

import typer
from sqlalchemy import Engine
from sqlalchemy.exc import SQLAlchemyError

from service.config import Settings, SettingsError, load_settings
from service.errors import CamindError

GROUP = "camind.commands"
WRONG_USE = 2

app = typer.Typer(
    help="Metres from one photograph, for any camera.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
cameras_app = typer.Typer(help="The cameras in the database.", no_args_is_help=True)
app.add_typer(cameras_app, name="cameras")


def main() -> None:
    """Run the command line; other packages' commands are loaded only where one may be meant."""
    own = {command.name or getattr(command.callback, "__name__", "") for command in app.registered_commands}
    wanted = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if wanted not in own | {"cameras"}:
        for entry_point in entry_points(group=GROUP):
            _add_commands(entry_point)
    app()


@app.command()
def serve(
    host: Annotated[str | None, typer.Option(help="Address to bind. [default: 127.0.0.1]")] = None,
    port: Annotated[int | None, typer.Option(help="TCP port, 0 for any. [default: 8000]")] = None,
    model: Annotated[Path | None, typer.Option(help="Model folder. [default: the shipped model]")] = None,
) -> None:
    """Answer requests until stopped. Everything else is set by CAMIND_* variables."""
    settings = _settings(host=host, port=port, model_dir=model)
    from service import logs, server
    from service.app import create_app
    from service.inference.artifact import load_model_folder

    logs.configure(settings.log_level, settings.log_format)
    with _plain_failures():
        listener = server.bind(settings.host, settings.port)
        load_model_folder(settings.served_model_dir)
        served = create_app(settings)
        if settings.is_database_embedded:
            _migrated(settings).dispose()
    typer.echo(f"camind on http://{settings.host}:{listener.getsockname()[1]}", err=True)
    if not settings.is_loopback:
        typer.echo("Other machines can reach it, and it asks nobody who they are.", err=True)
    if not server.serve(served, settings, listener):
        raise _failure("camind did not start: the log above says why.")


@app.command()
def migrate() -> None:
    """Bring the database to the newest schema."""
    from service.storage import schema

    with _plain_failures():
        engine = _migrated(_settings())
        typer.echo(f"The database is at {schema.current_revision(engine)}.")


@app.command()
def openapi() -> None:
    """Print the API's description (OpenAPI, YAML)."""
    from service.api.openapi import to_yaml
    from service.app import create_app

    typer.echo(to_yaml(create_app(_settings()).openapi()), nl=False)


@app.command()
def target(
    out: Annotated[Path, typer.Option(help="File to write: .pdf or .svg", dir_okay=False)] = Path("target.pdf"),
    kind: Literal["asymmetric_circles", "symmetric_circles"] = "asymmetric_circles",
    rows: Annotated[int, typer.Option(min=2, max=40)] = 11,
    columns: Annotated[int, typer.Option(min=2, max=40)] = 4,
    spacing_mm: Annotated[float, typer.Option(help="The spacing s of the grid")] = 20.0,
    diameter_mm: Annotated[float, typer.Option(help="Of each circle")] = 12.0,
    paper: Literal["a4", "letter"] = "a4",
) -> None:
    """Write the sheet of circles that a calibration photographs."""
    from service.calibration.target import WRITERS, CircleGrid, lay_out

    write = WRITERS.get(out.suffix.lower())
    if write is None:
        raise _failure(f"--out must end in {' or '.join(WRITERS)}, not {out.suffix or 'nothing'}", WRONG_USE)
    try:
        sheet = lay_out(CircleGrid(kind, rows, columns, spacing_mm, diameter_mm), paper)
    except ValueError as exc:
        raise _failure(str(exc), WRONG_USE) from exc
    try:
        out.write_bytes(write(sheet))
    except OSError as exc:
        raise _failure(str(exc)) from exc
    typer.echo(out)


@app.command()
def calibrate(
    folder: Annotated[
        Path, typer.Argument(help="Photographs, or the folders focused/ and defocused/ of them", exists=True)
    ],
    kind: Literal["asymmetric_circles", "symmetric_circles"] = "asymmetric_circles",
    rows: Annotated[int, typer.Option(min=2, max=40)] = 11,
    columns: Annotated[int, typer.Option(min=2, max=40)] = 4,
    spacing_mm: Annotated[float, typer.Option(help="The spacing s of the grid, as measured on the sheet")] = 20.0,
    diameter_mm: Annotated[float, typer.Option(help="Of each circle")] = 12.0,
    focus_distance_m: Annotated[float | None, typer.Option(help="Where the lens is focused. [default: found]")] = None,
    method: Literal["edge", "paper"] = "edge",
    out: Annotated[Path, typer.Option(help="Report to write; its plot goes beside it", dir_okay=False)] = Path(
        "calibration.json"
    ),
    register: Annotated[str | None, typer.Option(help="Camera to store, or to give a new revision")] = None,
) -> None:
    """Photographs of the sheet to a camera's k_cam, gamma, focus distance and intrinsics."""
    from service.calibration.calibrate import Task
    from service.calibration.target import CircleGrid
    from service.calibration_folder import calibrate_folder, summary
    from service.inference.images import ImageLimits

    settings = _settings()
    limits = ImageLimits(settings.max_image_bytes, settings.max_image_pixels)
    with _plain_failures():
        try:
            grid = CircleGrid(kind, rows, columns, spacing_mm, diameter_mm)
            report = calibrate_folder(folder, Task(grid, focus_distance_m, method), limits, out)
        except ValueError as exc:
            raise _failure(str(exc), WRONG_USE) from exc
    typer.echo("\n".join(summary(report)))
    if report.result is None:
        raise typer.Exit(1)
    if register is not None:
        from service.storage.cameras import Cameras

        with _plain_failures():
            record = Cameras(_ready_engine()).store_calibrated(register, report.result.to_camera())
        typer.echo(f"stored as {record.name}, revision {record.revision}")


@app.command(name="version")
def print_version() -> None:
    """Print the version."""
    typer.echo(version("camind"))


@cameras_app.command(name="seed")
def seed_cameras() -> None:
    """Store the cameras of the paper's Table 1; names already there are left as they are."""
    from service.storage.cameras import Cameras
    from service.storage.seeds import seed

    with _plain_failures():
        names = seed(Cameras(_ready_engine()))
    typer.echo("\n".join(names) if names else "Every seed is there already.")


@cameras_app.command(name="list")
def list_cameras() -> None:
    """Print name, revision, k_cam, focus distance and image size, a camera a line."""
    from service.storage.cameras import CameraRecord, Cameras

    def line(record: CameraRecord) -> str:
        camera = record.camera
        size = f"{camera.image_width_px}x{camera.image_height_px}"
        return f"{record.name}\tr{record.revision}\t{camera.k_cam_px:.4g} px\t{camera.focus_distance_m:g} m\t{size}"

    with _plain_failures():
        cameras, after, has_more = Cameras(_ready_engine()), None, True
        while has_more:
            records, has_more = cameras.page(100, after)
            for record in records:
                typer.echo(line(record))
            after = records[-1].name if records else None


def _settings(**overrides: object) -> Settings:
    try:
        return load_settings(**overrides)
    except SettingsError as exc:
        raise _failure(str(exc), WRONG_USE) from exc


def _migrated(settings: Settings) -> Engine:
    from service.storage import schema
    from service.storage.engine import open_engine

    engine = open_engine(settings.effective_database_url)
    schema.upgrade(engine)
    return engine


def _ready_engine() -> Engine:
    """The configured database, at the newest schema; one that others share is not migrated in passing."""
    from service.storage import schema
    from service.storage.engine import open_engine

    settings = _settings()
    if settings.is_database_embedded:
        return _migrated(settings)
    engine = open_engine(settings.effective_database_url)
    schema.require_head(engine)
    return engine


@contextmanager
def _plain_failures() -> Iterator[None]:
    """What an operator can mend is a message, not a traceback."""
    from service.inference.artifact import ModelFolderError

    try:
        yield
    except SQLAlchemyError as exc:
        raise _failure(f"The database cannot be used: {exc.args[0] if exc.args else exc}") from exc
    except (CamindError, ModelFolderError, SettingsError, OSError) as exc:
        raise _failure(str(exc)) from exc


def _failure(message: str, code: int = 1) -> typer.Exit:
    typer.echo(message, err=True)
    return typer.Exit(code)


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
