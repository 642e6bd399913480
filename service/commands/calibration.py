"""``camind target`` and ``camind calibrate``: a sheet of circles, and photographs of it to a camera."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from service.commands.failures import WRONG_USE, failure, plain_failures
from service.commands.opened import ready_engine, settings_with
from service.commands.options import Owner
from service.errors import BadRequest
from service.optics.camera import FOCUS_DISTANCES_M
from service.principal import LOCAL

if TYPE_CHECKING:
    from service.calibration.report import Result

NEAREST_M, FARTHEST_M = FOCUS_DISTANCES_M

app = typer.Typer()


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
        raise failure(f"--out must end in {' or '.join(WRITERS)}, not {out.suffix or 'nothing'}", WRONG_USE)
    try:
        sheet = lay_out(CircleGrid(kind, rows, columns, spacing_mm, diameter_mm), paper)
    except ValueError as exc:
        raise failure(str(exc), WRONG_USE) from exc
    try:
        out.write_bytes(write(sheet))
    except OSError as exc:
        raise failure(str(exc)) from exc
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
    from service.commands.calibration_folder import calibrate_folder, summary, write
    from service.inference.images import ImageLimits

    if method == "paper" and focus_distance_m is None:
        raise failure("--method paper needs --focus-distance-m: it cannot find it", WRONG_USE)
    settings = settings_with()
    limits = ImageLimits.of(settings)
    with plain_failures():
        if register is not None:
            _require_storable(register)
        try:
            grid = CircleGrid(kind, rows, columns, spacing_mm, diameter_mm)
            out.parent.mkdir(parents=True, exist_ok=True)
            report = calibrate_folder(folder, Task(grid, focus_distance_m, method), limits)
        except ValueError as exc:
            raise failure(str(exc), WRONG_USE) from exc
    typer.echo("\n".join(summary(report)))
    try:
        if register is not None and report.result is not None:
            _store_calibrated(register, report.result, owner)
    finally:
        with plain_failures():
            write(report, out)
    if report.result is None:
        raise typer.Exit(1)


def _require_storable(name: str) -> None:
    """A camera of this name will find its place in the database."""
    from service.storage.cameras import require_name
    from service.storage.engine import require_writable

    try:
        require_name(name)
    except BadRequest as exc:
        raise failure(str(exc), WRONG_USE) from exc
    with ready_engine() as engine:
        require_writable(engine)


def _store_calibrated(name: str, result: "Result", owner: str) -> None:
    from service.storage.cameras import Cameras

    with ready_engine() as engine:
        record = Cameras(engine, owner).store_calibrated(name, result.to_camera())
    typer.echo(f"stored as {record.name}, revision {record.revision}")
