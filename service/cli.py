"""The command ``camind``. Further commands come from packages that register in ``camind.commands``."""

import io
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from importlib.metadata import EntryPoint, entry_points, version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from sqlalchemy import Engine
from sqlalchemy.exc import SQLAlchemyError

from service.config import DATABASE_FILE, Settings, SettingsError, StorageSettings, load_settings, load_storage_settings
from service.errors import BadRequest, CamindError, Conflict, NotFound
from service.memory import end_uncollected, lasting
from service.optics.camera import FOCUS_DISTANCES_M
from service.principal import EVERYDAY, LOCAL, SCOPES

if TYPE_CHECKING:
    from service.calibration.report import Result
    from service.storage.cameras import CameraDraft, CameraRecord, Cameras

GROUP = "camind.commands"
WRONG_USE = 2
MOST_DAYS = 36_500.0  # the calendar has an end

app = typer.Typer(
    help="Metres from one photograph, for any camera.",
    context_settings={"help_option_names": ["--help", "-h"], "max_content_width": 120},
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
cameras_app = typer.Typer(help="The cameras in the database.", no_args_is_help=True)
app.add_typer(cameras_app, name="cameras")
calibrations_app = typer.Typer(help="The calibrations in the database.", no_args_is_help=True)
app.add_typer(calibrations_app, name="calibrations")
keys_app = typer.Typer(help="The API keys: who may use the service.", no_args_is_help=True)
app.add_typer(keys_app, name="keys")
NEAREST_M, FARTHEST_M = FOCUS_DISTANCES_M
Owner = Annotated[str, typer.Option(help="Whose they are. [default: whoever uses the service without a key]")]
CameraName = Annotated[str, typer.Argument(help="Of the camera")]


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
def serve(
    host: Annotated[str | None, typer.Option(help="Address to bind. [default: 127.0.0.1]")] = None,
    port: Annotated[int | None, typer.Option(help="TCP port, 0 for any. [default: 8000]")] = None,
    model: Annotated[Path | None, typer.Option(help="Model folder. [default: the shipped model]")] = None,
    seed: Annotated[bool, typer.Option("--seed", help="Give a database that never had a camera the paper's")] = False,
) -> None:
    """Answer requests until stopped. Everything else is set by CAMIND_* variables.

    Exit codes: 0 after SIGTERM, SIGINT or SIGHUP, once what was asked is answered; 143, 130 or 129 where a second one
    did not wait for that; 1 where it cannot start (the address, the model, the database); 2 for a wrong setting.
    """
    _end_in_order(0)
    settings = _settings(host=host, port=port, model_dir=model)
    with lasting():
        from service import logs, server
        from service.app import create_app
        from service.inference.artifact import load_model_folder
        from service.storage.cameras import has_had_cameras
        from service.storage.spool import Spool

    logs.configure(settings.log_level, settings.log_format)
    with _plain_failures():
        listener = server.bind(settings.host, settings.port)
        load_model_folder(settings.served_model_dir)
        served = create_app(settings)
        _require_sound(settings)
        with _opened(settings) as engine:
            if seed and settings.is_database_embedded and not has_had_cameras(engine):
                _seed(engine, LOCAL)
            if settings.wants_keys:
                _require_key(settings, engine)
        Spool(settings.spool_dir)
    address = f"[{settings.host}]" if ":" in settings.host else settings.host
    with suppress(OSError):  # a log's full disk is no reason not to serve
        typer.echo(f"camind on http://{address}:{listener.getsockname()[1]}", err=True)
        if not (settings.is_loopback or settings.wants_keys):
            typer.echo("Other machines can reach it, and it asks nobody who they are.", err=True)
    has_served = server.serve(served, settings, listener)
    _drop_unwritten()
    if not has_served:
        raise _failure("camind did not start: the log above says why.")


@app.command()
def migrate() -> None:
    """Bring the database to the newest schema."""
    from service.storage import schema

    with _plain_failures(), _opened(_storage(), is_migrated=True) as engine:
        typer.echo(f"The database is at {schema.current_revision(engine)}.")


@app.command(name="backup")
def back_up(
    file: Annotated[Path, typer.Argument(help="File to write", dir_okay=False)],
    force: Annotated[bool, typer.Option("--force", help="Overwrite it if it is there")] = False,
) -> None:
    """Copy the SQLite database to a file, whole and checked; a service may go on using it.

    Photographs that wait to be calibrated are not in it.
    """
    from service.storage.backup import backup, database_file

    _end_in_order()
    database = database_file(_storage().effective_database_url)
    if database is None:
        raise _failure("Only an SQLite file is backed up here: use pg_dump and pg_restore for PostgreSQL.", WRONG_USE)
    with _plain_failures():
        contents = backup(database, file, is_forced=force)
    typer.echo(f"{file} holds {contents}")


@app.command()
def restore(
    file: Annotated[Path, typer.Argument(help="What `camind backup` wrote", dir_okay=False)],
) -> None:
    """Put a backup in the SQLite database's place, at the newest schema; no service may use it meanwhile.

    The database that was there is kept beside it under a dated name. Where CAMIND_DATABASE_URL is an empty PostgreSQL
    database, after `camind migrate`, the backup's rows go there: that is how to change from SQLite; what pg_dump wrote
    is for pg_restore. Calibrations whose photographs are in another data folder than this one fail.
    """
    from service.storage.backup import database_file
    from service.storage.backup import restore as put_back
    from service.storage.spool import known_id

    _end_in_order()
    settings = _storage()
    database = database_file(settings.effective_database_url)
    with _plain_failures():
        if database is None:
            _move(file, settings)
            return
        contents, kept = put_back(file, database, known_id(settings.spool_dir))
    typer.echo(f"{database} holds {contents}")
    if kept is not None:
        typer.echo(f"What was there before is {kept}")


def _move(file: Path, settings: StorageSettings) -> None:
    from service.storage.move import move
    from service.storage.spool import known_id

    def tell(done: int, total: int) -> None:
        typer.echo(f"\r{done} of {total} rows", nl=done == total, err=True)

    with _ready_engine() as engine:
        contents = move(file, engine, settings.data_dir.resolve() / DATABASE_FILE, known_id(settings.spool_dir), tell)
    typer.echo(f"The PostgreSQL database holds {contents}")


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
    focus_distance_m: Annotated[
        float | None, typer.Option(min=NEAREST_M, max=FARTHEST_M, help="Where the lens is focused. [default: found]")
    ] = None,
    method: Literal["edge", "paper"] = "edge",
    out: Annotated[Path, typer.Option(help="Report to write; its plot goes beside it", dir_okay=False)] = Path(
        "calibration.json"
    ),
    register: Annotated[str | None, typer.Option(help="Camera to store, or to give a new revision")] = None,
    owner: Owner = LOCAL,
) -> None:
    """Photographs of the sheet to a camera's k_cam, gamma, focus distance and intrinsics."""
    from service.calibration.target import CircleGrid
    from service.calibration.task import Task
    from service.calibration_folder import calibrate_folder, summary, write
    from service.inference.images import ImageLimits

    if method == "paper" and focus_distance_m is None:
        raise _failure("--method paper needs --focus-distance-m: it cannot find it", WRONG_USE)
    settings = _settings()
    limits = ImageLimits.of(settings)
    with _plain_failures():
        if register is not None:
            _require_storable(register)
        try:
            grid = CircleGrid(kind, rows, columns, spacing_mm, diameter_mm)
            out.parent.mkdir(parents=True, exist_ok=True)
            report = calibrate_folder(folder, Task(grid, focus_distance_m, method), limits)
        except ValueError as exc:
            raise _failure(str(exc), WRONG_USE) from exc
    typer.echo("\n".join(summary(report)))
    try:
        if register is not None and report.result is not None:
            _store_calibrated(register, report.result, owner)
    finally:
        with _plain_failures():
            write(report, out)
    if report.result is None:
        raise typer.Exit(1)


def _store_calibrated(name: str, result: "Result", owner: str) -> None:
    from service.storage.cameras import Cameras

    with _ready_engine() as engine:
        record = Cameras(engine, owner).store_calibrated(name, result.to_camera())
    typer.echo(f"stored as {record.name}, revision {record.revision}")


@app.command()
def depth(
    photographs: Annotated[list[Path], typer.Argument(help="Photographs, or folders of them", exists=True)],
    camera: Annotated[str, typer.Option(help="Name of the camera that took them")],
    out: Annotated[Path, typer.Option(help="Folder to write to", file_okay=False)] = Path("depth"),
    formats: Annotated[
        list[str] | None,
        typer.Option("--format", help="png, npy, npz, tiff, ply, preview or json; may be repeated. [default: png]"),
    ] = None,
    side: Literal["auto", "near", "far"] = "auto",
    focus_distance_m: Annotated[float | None, typer.Option(help="Theirs, if not the camera's")] = None,
    at: Annotated[list[str] | None, typer.Option(help="Pixel u,v to read; may be repeated")] = None,
    maps: Annotated[
        list[str] | None, typer.Option(help="Map that an npz holds; may be repeated. [default: all]")
    ] = None,
    known: Annotated[list[str] | None, typer.Option(help="Known depth u,v,depth_m; may be repeated")] = None,
    roi: Annotated[str | None, typer.Option(help="Part u0,v0,u1,v1 to answer alone")] = None,
    longest_px: Annotated[int | None, typer.Option(help="Longer side of the map at most. [default: full size]")] = None,
    only_missing: Annotated[bool, typer.Option("--only-missing", help="Leave out what is there already")] = False,
    model: Annotated[Path | None, typer.Option(help="Model folder. [default: the shipped model]")] = None,
    owner: Owner = LOCAL,
) -> None:
    """Photographs to depth, without a service: what POST /depth answers, into files.

    Exit codes: 0; 1 where one of them has no depth, 2 for wrong options.
    """
    settings, formats = _settings(model_dir=model), formats or ["png"]
    with lasting():
        from service.depth_folder import Errand, depth_folder, query_of
        from service.inference.images import ImageLimits

    lists = {"at": at or (), "maps": maps or (), "known": known or ()}
    asked = {"side": side, "focus_distance_m": focus_distance_m, "roi": roi, "longest_px": longest_px, **lists}
    try:
        query = query_of(camera, asked, formats)
        with _plain_failures():
            with _ready_engine() as engine:
                record = _camera(engine, owner, camera)
            errand = Errand(record, query, formats, ImageLimits.of(settings), out)
            failed = depth_folder(photographs, errand, settings, is_missing_only=only_missing)
    except ValueError as exc:
        raise _failure(str(exc), WRONG_USE) from exc
    if failed:
        raise typer.Exit(1)


@app.command(name="version")
def print_version() -> None:
    """Print the version."""
    typer.echo(version("camind"))


@cameras_app.command(name="seed")
def seed_cameras(owner: Owner = LOCAL) -> None:
    """Store the cameras of the paper's Table 1; names already there are left as they are."""
    with _ready_engine() as engine:
        names = _seed(engine, owner)
    typer.echo("\n".join(names) if names else "Every seed is there already.")


def _seed(engine: Engine, owner: str) -> list[str]:
    from service.storage.cameras import Cameras
    from service.storage.seeds import seed

    return seed(Cameras(engine, owner))


@cameras_app.command(name="add")
def add_camera(
    file: Annotated[
        typer.FileBinaryRead,
        typer.Argument(help="JSON as POST /cameras takes it, or as the page exports cameras; - for standard input"),
    ],
    replace: Annotated[
        bool, typer.Option("--replace", help="A new revision, where a camera of that name is there and not the same")
    ] = False,
    owner: Owner = LOCAL,
) -> None:
    """Store a camera, known by its k_cam and gamma or by its lens specs, or several."""
    import json

    from pydantic import ValidationError

    from service.api.camera_schemas import CameraCreate
    from service.api.problems import invalid_model
    from service.storage.cameras import Cameras

    with _plain_failures():
        try:
            told = json.load(file)
            bodies = told["cameras"] if isinstance(told, dict) and isinstance(told.get("cameras"), list) else [told]
            drafts = [body.to_draft(body.name) for body in map(CameraCreate.model_validate, bodies)]
        except ValidationError as exc:
            raise _failure(str(invalid_model(exc, "body")), WRONG_USE) from exc
        except ValueError as exc:
            raise _failure(f"This is not valid JSON: {exc}", WRONG_USE) from exc
        with _ready_engine() as engine:
            for draft in drafts:
                typer.echo(_line_of(_stored(Cameras(engine, owner), draft, replace=replace)))


def _stored(cameras: "Cameras", draft: "CameraDraft", *, replace: bool) -> "CameraRecord":
    """The camera, new, or at a new revision, or as it is where that would be the same."""
    try:
        return cameras.add(draft)
    except Conflict as exc:
        if not replace:
            raise _failure(f"A camera '{draft.name}' exists already: --replace gives it a new revision.") from exc
    record = cameras.get(draft.name)
    if record.draft != draft:
        return cameras.replace(draft)
    typer.echo("unchanged:", err=True)
    return record


@cameras_app.command(name="show")
def show_camera(name: CameraName, owner: Owner = LOCAL) -> None:
    """Print a camera as the JSON that add takes."""
    from service.api.camera_schemas import CameraCreate

    with _ready_engine() as engine:
        record = _camera(engine, owner, name)
    typer.echo(CameraCreate.from_record(record).model_dump_json(indent=2, exclude_none=True))


@cameras_app.command(name="delete")
def delete_camera(name: CameraName, owner: Owner = LOCAL) -> None:
    """Free a camera's name; what was stored of it stays in the database."""
    from service.storage.cameras import Cameras

    with _ready_engine() as engine:
        record = _camera(engine, owner, name)
        Cameras(engine, owner).delete(name)
    typer.echo(_line_of(record))


def _camera(engine: Engine, owner: str, name: str) -> "CameraRecord":
    from service.storage.cameras import Cameras, camera_counts

    try:
        return Cameras(engine, owner).get(name)
    except NotFound as exc:
        told = "camind cameras list names those there are, camind cameras add stores one"
        others = _of_others(camera_counts(engine, name))
        raise _failure(f"There is no camera '{name[:64]}'{others}: {told}.") from exc


def _of_others(counts: dict[str, int]) -> str:
    """Who else has cameras, to be said after a sentence that there is none."""
    owners = ", ".join(f"{count} of {owner}" for owner, count in counts.items())
    return f" of this owner, but {owners} (--owner)" if owners else ""


@cameras_app.command(name="list")
def list_cameras(owner: Owner = LOCAL) -> None:
    """Print name, revision, k_cam, focus distance and image size, a camera a line."""
    from service.storage.cameras import Cameras, camera_counts

    with _ready_engine() as engine:
        cameras, after, has_more = Cameras(engine, owner), None, True
        while has_more:
            records, has_more = cameras.page(100, after)
            for record in records:
                typer.echo(_line_of(record))
            after = records[-1].name if records else None
        if after is None and (others := _of_others(camera_counts(engine))):
            typer.echo(f"There is no camera{others}.", err=True)


def _line_of(record: "CameraRecord") -> str:
    camera = record.camera
    size = f"{camera.image_width_px}x{camera.image_height_px}"
    return f"{record.name}\tr{record.revision}\t{camera.k_cam_px:.4g} px\t{camera.focus_distance_m:g} m\t{size}"


@calibrations_app.command(name="prune")
def prune_calibrations(
    days: Annotated[float, typer.Option(help="How long what has ended is kept", min=1.0, max=MOST_DAYS)],
) -> None:
    """Delete, of every owner, what ended longer ago than that. The cameras that came of it stay."""
    from service.storage.calibrations import Calibrations

    with _ready_engine() as engine:
        count = Calibrations(engine).forget(datetime.now(UTC) - timedelta(days=days))
    typer.echo(f"deleted calibrations: {count}")


@keys_app.command(name="create")
def create_key(
    name: Annotated[str, typer.Argument(help="What to call it")],
    scope: Annotated[
        list[str] | None, typer.Option(help=f"May be repeated: {', '.join(SCOPES)}. [default: all but admin]")
    ] = None,
    owner: Annotated[
        str | None, typer.Option(help="Whose cameras and calibrations it works with. [default: its name]")
    ] = None,
    days: Annotated[
        float | None, typer.Option(help="How long it is good. [default: for ever]", min=0.0, max=MOST_DAYS)
    ] = None,
) -> None:
    """Make an API key and print it: it is not stored and cannot be shown again."""
    from service.storage.keys import Keys

    scopes = [known for known in SCOPES if known in (scope or EVERYDAY)]
    unknown = sorted(set(scope or ()) - set(scopes))
    if unknown:
        raise _failure(f"There is no scope {', '.join(unknown)}: take {', '.join(SCOPES)}.", WRONG_USE)
    expires_at = None if days is None else datetime.now(UTC) + timedelta(days=days)
    with _ready_engine() as engine:
        key, text = Keys(engine).create(name, owner or name, scopes, expires_at)
    until = f"until {key.expires_at:%Y-%m-%d %H:%M} UTC" if key.expires_at else "until it is revoked"
    typer.echo(f"Key {key.id} for {key.owner}: {', '.join(scopes)}; good {until}. It is shown this once:", err=True)
    typer.echo(text)


@keys_app.command(name="list")
def list_keys() -> None:
    """Print id, name, owner, scopes, state, expiry and last use, a key a line."""
    from service.storage.keys import ApiKey, Keys

    now = datetime.now(UTC)

    def moment(time: datetime | None) -> str:
        return f"{time:%Y-%m-%d %H:%M}" if time else "never"

    def line(key: ApiKey) -> str:
        state = "good" if key.is_good(now) else "revoked" if key.revoked_at else "expired"
        scopes = ",".join(scope for scope in SCOPES if scope in key.scopes)
        dates = f"expires {moment(key.expires_at)}\tused {moment(key.last_used_at)}"
        return f"{key.id}\t{key.name}\t{key.owner}\t{scopes}\t{state}\t{dates}"

    with _ready_engine() as engine:
        for key in Keys(engine).every():
            typer.echo(line(key))


@keys_app.command(name="revoke")
def revoke_key(key_id: Annotated[str, typer.Argument(help="As `camind keys list` shows it")]) -> None:
    """Refuse a key from now on; what it made stays with its owner."""
    from service.storage.keys import Keys

    with _ready_engine() as engine:
        key = Keys(engine).revoke(key_id)
    typer.echo(f"Key {key.id} ({key.name}) is refused from now on.")


def _end_in_order(code: int | None = None) -> None:
    """Let signals that would end the process at once end it as an error does, with ``code`` or as a shell tells it.

    No half of a database is left behind; and a container's first process is not told of signals it has no handler for.
    """
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, lambda number, _: sys.exit(128 + number if code is None else code))


def _drop_unwritten() -> None:
    """Let the log's last lines go where there is no room for them: Python would end as if the service had failed."""
    try:
        sys.stderr.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())


def _settings(**overrides: object) -> Settings:
    with _plain_failures(WRONG_USE):
        return load_settings(**overrides)


def _storage() -> StorageSettings:
    """Where the data are: how they are served is no matter of a command on them."""
    with _plain_failures(WRONG_USE):
        return load_storage_settings()


def _require_key(settings: Settings, engine: Engine) -> None:
    from service.storage import schema
    from service.storage.keys import Keys

    try:
        has_key = Keys(engine).has_good()
    except CamindError:
        schema.require_head(engine)  # which says it better
        raise
    if not has_key:
        raise _failure(
            f"Requests to {settings.host} need an API key, and there is none: make one with `camind keys create NAME`, "
            "or set CAMIND_API_KEYS=off to let everybody in.",
            WRONG_USE,
        )


@contextmanager
def _opened(settings: StorageSettings, *, is_migrated: bool = False) -> Iterator[Engine]:
    """The configured database, which nobody restores meanwhile; one that others share is migrated only where asked."""
    from service.storage import schema
    from service.storage.backup import using
    from service.storage.engine import open_engine

    with using(settings.effective_database_url):
        engine = open_engine(settings.effective_database_url)
        try:
            if is_migrated or settings.is_database_embedded:
                schema.upgrade(engine)
            yield engine
        finally:
            engine.dispose()


@contextmanager
def _ready_engine() -> Iterator[Engine]:
    """The configured database, at the newest schema; what fails with it is a message."""
    from service.storage import schema

    with _plain_failures(), _opened(_storage()) as engine:
        schema.require_head(engine)
        yield engine


def _require_storable(name: str) -> None:
    """A camera of this name will find its place in the database."""
    from service.storage.cameras import require_name
    from service.storage.engine import require_writable

    try:
        require_name(name)
    except BadRequest as exc:
        raise _failure(str(exc), WRONG_USE) from exc
    with _ready_engine() as engine:
        require_writable(engine)


def _require_sound(settings: StorageSettings) -> None:
    from service.storage.backup import database_file, require_sound, using

    database = database_file(settings.effective_database_url)
    if database is not None:
        with using(settings.effective_database_url):
            require_sound(database)


@contextmanager
def _plain_failures(code: int = 1) -> Iterator[None]:
    """What an operator can mend is a message, not a traceback."""
    from service.inference.artifact import ModelFolderError

    try:
        yield
    except SQLAlchemyError as exc:
        if isinstance(exc.__context__, SystemExit):
            raise exc.__context__ from None  # a signal came amid a statement, which is not the database's fault
        raise _failure(f"The database cannot be used: {_reason(exc)}", code) from exc
    except BrokenPipeError:
        raise  # whoever read what is printed has enough
    except UnicodeEncodeError as exc:
        raise _failure(f"{ascii(exc.object)[:80]} is no text: its bytes are no UTF-8.", WRONG_USE) from exc
    except (CamindError, ModelFolderError, SettingsError, OSError) as exc:
        cause = exc.__cause__ if isinstance(exc, CamindError) and exc.status >= 500 else None
        raise _failure(f"{exc}\n{_reason(cause)}" if cause else str(exc), code) from exc


def _reason(cause: BaseException) -> str:
    """What a library says went wrong, in one line and without the statement it was at."""
    return " ".join(str(cause.args[0] if cause.args else cause).split())


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
