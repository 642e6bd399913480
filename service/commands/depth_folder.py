"""Depth of photographs on a disk, for the command line: a progress bar, files, and a table."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError
from rich.console import Console
from rich.table import Table

from service.api.depth_schemas import DepthQuery, DepthRead
from service.api.orders import JSON, Order, fulfil
from service.api.problems import invalid_model
from service.api.uploads import Upload
from service.config import Settings
from service.errors import CamindError
from service.inference.artifact import load_model_folder
from service.inference.cancellation import Cancellation
from service.inference.estimator import Estimator
from service.inference.images import SUFFIXES, ImageLimits, photographs_in
from service.memory import keep_freed_memory
from service.metres import in_words
from service.storage.cameras import CameraRecord
from service.storage.disk import write_through
from service.terminal import name_column, print_table, progress_bar, shown

ENDINGS = {"preview": ".jpg"}  # of the others it is their name


@dataclass(frozen=True, slots=True)
class Errand:
    """What is wanted of every photograph, and the folder it goes to."""

    record: CameraRecord
    query: DepthQuery
    formats: Sequence[str]
    limits: ImageLimits
    out: Path

    def is_done(self, photograph: Path) -> bool:
        """Whether all that is wanted of a photograph is there."""
        return all(file.exists() for file in self.files_of(photograph).values())

    def files_of(self, photograph: Path) -> dict[str, Path]:
        """Where what is made of a photograph goes, by format."""
        names = {wanted: photograph.stem + ENDINGS.get(wanted, f".{wanted}") for wanted in self.formats}
        return {wanted: self.out / name for wanted, name in names.items()}


def query_of(camera: str, asked: Mapping[str, object], formats: Sequence[str]) -> DepthQuery:
    """What is asked of photographs, in formats. Raises ``ValueError`` that says what cannot be asked."""
    try:
        queries = [DepthQuery.model_validate({"camera": camera, **asked, "format": form}) for form in formats]
    except ValidationError as exc:
        raise ValueError(str(invalid_model(exc, "option"))) from exc
    return queries[0]


@dataclass(frozen=True, slots=True)
class Made:
    """What came of a photograph: its depth in numbers, the focus distance used and warnings; or why there is none."""

    read: DepthRead | None = None
    focus_m: float | None = None
    remarks: str = ""

    @property
    def has_depth(self) -> bool:
        """Whether there is an answer anywhere in it."""
        return self.read is not None and self.read.valid_fraction > 0


def depth_folder(places: Sequence[Path], errand: Errand, settings: Settings, *, is_missing_only: bool = False) -> int:
    """Write depth of the photographs named and of those in folders named, print a table; how many have none.

    Raises ``ValueError`` where there is nothing to read or nowhere to write, ``ModelFolderError``.
    """
    every = _photographs(places, errand.out)
    wanted = [path for path in every if not (is_missing_only and errand.is_done(path))]
    failed = 0
    if wanted:
        folder = load_model_folder(settings.served_model_dir)
        estimator = Estimator.from_folder(folder, intra_op_threads=settings.threads_per_worker)
        keep_freed_memory()
        errand.out.mkdir(parents=True, exist_ok=True)
        made = _all_made(wanted, errand, estimator, settings.worker_slots)
        failed = sum(not one.has_depth for one in made.values())
    there = f", and had that of {len(every) - len(wanted)}" if is_missing_only else ""
    told = f"{errand.out} has depth of {len(wanted) - failed} of {len(wanted)} photographs{there}"
    Console(soft_wrap=True, markup=False, emoji=False).print(told, highlight=False)
    return failed


def _photographs(places: Sequence[Path], out: Path) -> list[Path]:
    """The photographs named and those in the folders named, each once.

    Raises ``ValueError`` where there is none, where two would become one file, and where what is made of one would lie
    among them.
    """
    every = dict.fromkeys(path for place in places for path in (photographs_in(place) if place.is_dir() else [place]))
    if not every:
        raise ValueError(f"no photographs in {', '.join(map(str, places))}: {', '.join(sorted(SUFFIXES))} are read")
    if any(path.parent.resolve() == out.resolve() for path in every):
        raise ValueError(f"{out} holds photographs: say with --out where depth is to go")
    first: dict[str, Path] = {}
    for path in every:
        if first.setdefault(path.stem, path) != path:
            remedy = f"name the photographs, such as {path.parent}/*{path.suffix}"
            raise ValueError(f"{first[path.stem]} and {path} would become one file: {remedy}")
    return list(every)


def _all_made(photographs: Sequence[Path], errand: Errand, estimator: Estimator, slots: int) -> dict[Path, Made]:
    """What came of each, under a progress bar and then in a table; one that cannot be read keeps no other from it."""
    made: dict[Path, Made] = {}
    cancellation = Cancellation()
    try:
        with progress_bar() as progress, ThreadPoolExecutor(slots) as pool:
            bar = progress.add_task("depth", total=len(photographs))
            running = {pool.submit(_made, path, errand, estimator, cancellation): path for path in photographs}
            try:
                for done in as_completed(running):
                    made[running[done]] = done.result()
                    progress.advance(bar)
            except BaseException:
                cancellation.cancel()
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    finally:
        _print([(path, made[path]) for path in photographs if path in made])
    return made


def _made(photograph: Path, errand: Errand, estimator: Estimator, cancellation: Cancellation) -> Made:
    forms = tuple(dict.fromkeys((*errand.formats, JSON)))
    try:
        order = Order.of(Upload(photograph.read_bytes(), None), errand.record, errand.query, forms, errand.limits)
        answer = fulfil(cancellation, order, estimator)
        bodies = {form: encoded.body for form, encoded in zip(forms, answer.encoded, strict=True)}
        for form, file in errand.files_of(photograph).items():
            _write(file, bodies[form])
    except (CamindError, OSError) as exc:
        return Made(remarks=str(exc))
    except MemoryError:
        return Made(remarks="there is too little memory for it")
    return Made(DepthRead.model_validate_json(bodies[JSON]), answer.camera.focus_distance_m, "; ".join(answer.warnings))


def _write(file: Path, body: bytes) -> None:
    """All of it or nothing, after a power cut too: the name is given to what is on the disk."""
    part = file.with_name(f".{file.name}.part")
    try:
        with part.open("wb") as stream:
            stream.write(body)
            write_through(stream)
        part.replace(file)
    except OSError:
        part.unlink(missing_ok=True)
        raise


def _print(made: Sequence[tuple[Path, Made]]) -> None:
    depths = Table(name_column(), "median m", "5 to 95 % m", "answered", "focus m", "", box=None, pad_edge=False)
    points = Table(name_column(), "u", "v", "depth m", "sigma m", "other side m", box=None, pad_edge=False)
    for path, one in made:
        if one.read is None:
            depths.add_row(shown(path.name), "", "", "", "", f"no depth: {one.remarks}")
            continue
        spread = one.read.depth_m
        numbers = _metres(spread.median), f"{_metres(spread.p5)} to {_metres(spread.p95)}"
        depths.add_row(shown(path.name), *numbers, f"{one.read.valid_fraction:.0%}", f"{one.focus_m:.4g}", one.remarks)
        for at in one.read.points:
            found = (at.depth_m, at.sigma_m, at.depth_alt_m)
            told = (_metres(value, at.depth_m) for value in found)
            points.add_row(shown(path.name), f"{at.u:g}", f"{at.v:g}", *told)
    for table in (depths, points):
        if table.row_count:
            print_table(table)


def _metres(value: float | None, like: float | None = None) -> str:
    return "-" if value is None else in_words(value, like)
