"""A calibration from a folder of photographs, for the command line: progress, report, plot and a summary."""

from pathlib import Path

from pydantic import TypeAdapter
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from service.calibration.calibrate import calibrate
from service.calibration.report import Interval, PictureReport, Report, Role
from service.calibration.task import Picture, Shot, Task
from service.errors import InvalidImage
from service.inference.images import SUFFIXES, ImageLimits, photographs_in, read_stored_frame
from service.metres import in_words
from service.terminal import name_column, print_table, shown

REPORT = TypeAdapter(Report)


def pictures_in(folder: Path, limits: ImageLimits) -> list[Picture]:
    """The photographs in ``focused/`` and ``defocused/``; without these folders all of the folder's are defocused.

    Raises ``ValueError`` where there is none.
    """
    roles: dict[Role, Path] = {"focused": folder / "focused", "defocused": folder / "defocused"}
    if not any(place.is_dir() for place in roles.values()):
        roles = {"defocused": folder}
    pictures = [_picture(path, role, limits) for role, place in roles.items() for path in photographs_in(place)]
    if not any(picture.role == "defocused" for picture in pictures):
        raise ValueError(f"no photographs in {roles['defocused']}: {', '.join(sorted(SUFFIXES))} are read")
    return pictures


def _picture(path: Path, role: Role, limits: ImageLimits) -> Picture:
    name = f"{path.parent.name}/{path.name}" if path.parent.name == role else path.name
    return Picture(shown(name), role, lambda: _shot(path, limits))


def _shot(path: Path, limits: ImageLimits) -> Shot:
    """The photograph as the sensor had it. Raises ``InvalidImage`` for a file that cannot be read, too."""
    try:
        data = path.read_bytes()
    except OSError as exc:
        raise InvalidImage(f"The file cannot be read: {exc.strerror}.") from exc
    frame = read_stored_frame(data, limits)
    return Shot(frame.rgb, frame.exif.f_number)


def calibrate_folder(folder: Path, task: Task, limits: ImageLimits) -> Report:
    """Calibrate under a progress bar, and print what each photograph gave."""
    pictures = pictures_in(folder, limits)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        bar = progress.add_task(f"{len(pictures)} photographs", total=1.0)

        def tell(done: float, _: tuple[PictureReport, ...]) -> None:
            progress.update(bar, completed=done)

        report = calibrate(task, pictures, tell=tell)
        progress.update(bar, completed=1.0)
    print_table(_table(report))
    return report


def write(report: Report, out: Path) -> None:
    """The report as JSON, and the plot of a result beside it."""
    out.write_bytes(REPORT.dump_json(report, indent=1))
    if report.result is not None:
        from service.calibration.plot import as_svg

        out.with_name(f"{out.name.removesuffix('.json')}.svg").write_bytes(as_svg(report.result))


def _table(report: Report) -> Table:
    table = Table(name_column(), "circles", "blur px", "distance m", "tilt deg", "", box=None, pad_edge=False)
    for picture in report.pictures:
        distance = "" if picture.distance_m is None else in_words(picture.distance_m)
        blur, tilt = (
            "" if value is None else format(value, form)
            for value, form in ((picture.blur_px, ".2f"), (picture.tilt_deg, ".0f"))
        )
        table.add_row(picture.name, str(picture.circles), blur, distance, tilt, "; ".join(picture.warnings))
    return table


def summary(report: Report) -> list[str]:
    """The constants with their intervals and warnings, a line each."""
    if report.result is None:
        return [f"no result: {report.problem}"]
    result = report.result

    def line(name: str, unit: str, found: Interval) -> str:
        return f"{name:17s} {found.value:8.4g} {unit:3s} 95 % [{found.low:.4g}, {found.high:.4g}]"

    return [
        line("k_cam_px", "px", result.k_cam_px),
        line("gamma_px", "px", result.gamma_px),
        line("focus_distance_m", "m", result.focus_distance_m),
        f"{'fx_px':17s} {result.intrinsics.fx_px:8.1f} px  reprojection {result.reprojection_rms_px:.2f} px rms",
        *([] if result.f_number is None else [f"{'f_number':17s} {result.f_number:8.4g}"]),
        *(f"warning: {words}" for words in result.warnings),
    ]
