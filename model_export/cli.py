"""What training adds to ``camind``: train, narrow, average, export, verify, evaluate, bench, blender, homes, data."""

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.console import Console
from rich.table import Column, Table

from model_export.config import MOST_SEED, Kind, Part
from service.config import INT8, SHIPPED_MODEL
from service.inference.artifact import load_model_folder
from service.terminal import print_table, progress_bar

if TYPE_CHECKING:  # importing torch takes seconds; a command that needs it does so itself
    from model_export.summary import Report
    from model_export.verify import Difference

commands = typer.Typer(help="Train, export and score models.")
bench = typer.Typer(help="Measure speed, or accuracy where the truth is known.", invoke_without_command=True)
commands.add_typer(bench, name="bench")

Model = Annotated[Path, typer.Option(help="model folder", file_okay=False)]
Textures = Annotated[Path, typer.Option(help="folder of pictures with LICENCES.md", exists=True, file_okay=False)]
Frames = Annotated[
    Path | None, typer.Option(help="sharp pictures with depth, of camind homes: four scenes in ten", exists=True)
]
Teachers = Annotated[
    list[Path] | None,
    typer.Option(help="checkpoint or model folder to learn the answers of, too; of several their mean", exists=True),
]
Seed = Annotated[int | None, typer.Option(min=0, max=MOST_SEED, help="the same seed is the same run", show_default="1")]
LearningRate = Annotated[float | None, typer.Option(min=1e-6, max=1e-2, help="before it falls", show_default="0.001")]
Threads = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="cores that torch computes on, shared with the workers or not",
        show_default="those that workers leave",
    ),
]
Data = Annotated[
    Path,
    typer.Option(
        help="folder with rgbd/, tabletop/, d200/, blender/, or any with cameras.json (what is there is used)",
        exists=True,
    ),
]
Dataset = Literal["defocusnet", "ddff12", "nyu"]
CheckpointPath = Annotated[Path, typer.Option(help="checkpoint file of a run, or a model folder", exists=True)]

BLENDER_ENVIRONMENT = Path(".venv-blender")


def _fail(message: str) -> typer.Exit:
    typer.secho(message, err=True, fg="red")
    return typer.Exit(1)


@contextmanager
def _training_parts() -> Iterator[None]:
    """Around the imports that need torch, which take seconds: what is missing is said with its remedy."""
    try:
        with Console(stderr=True).status("loading"):
            yield
    except ModuleNotFoundError as exc:
        raise _fail(f"{exc.name} is not installed: `make setup` brings it, or pip install 'camind[train]'") from exc


@contextmanager
def _plain_failures() -> Iterator[None]:
    """Around what reads and writes folders: what is wrong with them is said in a line."""
    try:
        yield
    except (OSError, ValueError) as exc:
        raise _fail(str(exc)) from exc


@commands.command()
def train(
    run: Annotated[
        Path, typer.Option(help="folder of the run: goes on from its checkpoint", file_okay=False, writable=True)
    ],
    textures: Textures,
    frames: Frames = None,
    kind: Annotated[Kind | None, typer.Option(help="ours or the paper's pair", show_default="compact")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="batches in the whole run", show_default="12000")] = None,
    seed: Seed = None,
    weights: Annotated[
        Path | None, typer.Option(help="checkpoint or model folder whose weights a new run begins with", exists=True)
    ] = None,
    fresh_decoders: Annotated[
        bool, typer.Option("--fresh-decoders", help="of --weights the encoders alone: decoders and heads begin anew")
    ] = False,
    teacher: Teachers = None,
    learning_rate: LearningRate = None,
    setting: Annotated[
        list[str] | None,
        typer.Option(help="anything else of the run: decay_share=0.8, scenes.frame_share=0.5, scenes.k_cam_px=[1,20]"),
    ] = None,
    workers: Annotated[int, typer.Option(min=0, max=64, help="processes that draw scenes")] = 1,
    threads: Threads = None,
    device: Annotated[str, typer.Option(help="torch device")] = "cpu",
) -> None:
    """Train a pair of networks on procedural scenes; stop (Ctrl-C) and start it as you like.

    A run that is gone on with has what it was begun with, but for what is given anew, which is said.
    """
    with _training_parts():
        from model_export import train as training

    told = {"kind": kind, "steps": steps, "seed": seed, "learning_rate": learning_rate}
    given = [f"{name}={json.dumps(value)}" for name, value in told.items() if value is not None]
    with _plain_failures():
        path = training.train(
            training.config_of(run, [*given, *(setting or ())]),
            textures,
            run,
            frames=frames,
            weights=weights,
            fresh_decoders=fresh_decoders,
            teachers=teacher or (),
            workers=workers,
            threads=threads,
            device=device,
        )
    typer.echo(path)


def _channels(text: str) -> tuple[int, ...]:
    parts = text.split("-")
    if not all(part.isdecimal() for part in parts):
        raise _fail(f"channels are numbers such as 16-32-48-96, not {text}")
    return tuple(map(int, parts))


@commands.command()
def narrow(
    textures: Textures,
    out: Annotated[Path, typer.Option(help="checkpoint file to write, for train --weights", dir_okay=False)],
    blur: Annotated[str, typer.Option(help="channels of the blur network, finest level first: 16-32-48-96")],
    depth: Annotated[str, typer.Option(help="channels of the depth network: 16-16-16-48")],
    model: Model = SHIPPED_MODEL,
) -> None:
    """Leave channels out of the compact pair: what they say is written as sums of the others, then trained on from."""
    with _training_parts():
        from model_export.narrowed import narrow as run_narrowing
        from model_export.networks import Widths

    with _plain_failures():
        change = run_narrowing(model, textures, Widths(_channels(blur), _channels(depth)), out)
    typer.echo(f"{out}: on other scenes blur is {change.blur:.1%} and depth {change.depth:.1%} off that of {model}")


@commands.command()
def average(
    first: Annotated[Path, typer.Argument(help="checkpoint file", exists=True, dir_okay=False)],
    second: Annotated[Path, typer.Argument(help="checkpoint file", exists=True, dir_okay=False)],
    out: Annotated[Path, typer.Option(help="checkpoint file to write", dir_okay=False)],
    share: Annotated[
        float, typer.Option(min=-1, max=1, help="the second's part; below 0 beyond the first, away from the second")
    ] = 0.5,
    part: Annotated[Part | None, typer.Option(help="of that alone; the rest stays the first's")] = None,
) -> None:
    """Mean of the weights of two checkpoints, one trained on from the other."""
    with _training_parts():
        from model_export.checkpoint import Checkpoint

    with _plain_failures():
        Checkpoint.load(first).averaged(Checkpoint.load(second), share, part or "").save(out)
    typer.echo(out)


@commands.command()
def export(
    checkpoint: CheckpointPath,
    out: Annotated[Path, typer.Option(help="model folder to write", file_okay=False, writable=True)],
    textures: Annotated[
        Path | None,
        typer.Option(help="pictures that a run was trained with, with LICENCES.md", exists=True, file_okay=False),
    ] = None,
    frames: Frames = None,
    name: Annotated[str | None, typer.Option(help="name of the model")] = None,
) -> None:
    """Write a checkpoint as a model folder, and in it one in int8: graphs (ONNX), card and manifest each.

    A model folder is written anew, as what this version makes of its weights; its card says what they learned from.
    """
    if textures is None and checkpoint.is_file():
        raise _fail("the card of a run states the licences of its pictures: name them with --textures")
    if out.resolve() == checkpoint.resolve():
        raise _fail(f"{out} would be written over while it is read")
    with _training_parts():
        from model_export.corrections import ALL_SCENES, record_corrections, unseen_cases
        from model_export.export import export_checkpoint
        from model_export.quantised import quantised_graphs

    pictures = [folder for folder in (textures, frames) if folder is not None]
    # what breaks off leaves no folder that serves, without its corrections
    with TemporaryDirectory() as scratch, progress_bar() as progress, _plain_failures():
        built = Path(scratch)
        task = progress.add_task("float32", total=4)
        manifest = export_checkpoint(checkpoint, pictures, built, name)
        out.mkdir(parents=True, exist_ok=True)  # or not, which is said before minutes of work
        progress.update(task, advance=1, description=INT8)
        in_int8 = partial(quantised_graphs, floating=built)
        export_checkpoint(checkpoint, pictures, built / INT8, f"{manifest.name}-{INT8}", in_int8)
        progress.update(task, advance=1, description="corrections")
        cases = list(progress.track(unseen_cases(), ALL_SCENES, description="held-out scenes"))
        found = {}
        for folder in (Path(), Path(INT8)):
            found[out / folder] = record_corrections(built / folder, cases)
            progress.advance(task)
        shutil.copytree(built, out, dirs_exist_ok=True)
    for folder, (gain, temperature) in found.items():
        typer.echo(f"{folder}: blur times {gain:.3f}, stated errors times {temperature:.2f}")


@commands.command()
def verify(checkpoint: CheckpointPath, model: Model = SHIPPED_MODEL) -> None:
    """Compare torch with ONNX Runtime on three sizes; fails above 1e-3 relative."""
    with _training_parts():
        from model_export.verify import TOLERANCE, verify_checkpoint

    with _plain_failures():
        differences = verify_checkpoint(checkpoint, model)
    print_table(_differences(differences))
    worst = max(d.relative for d in differences)
    if not worst <= TOLERANCE:
        raise _fail(f"largest relative difference {worst:.1e} is above {TOLERANCE:.0e}")


def _differences(differences: "list[Difference]") -> Table:
    table = Table("size", "graph", "output", "largest relative difference")
    for d in differences:
        table.add_row(f"{d.width_px}x{d.height_px}", d.graph, d.output, f"{d.relative:.1e}")
    return table


@commands.command()
def evaluate(
    data: Data,
    model: Model = SHIPPED_MODEL,
    beside: Annotated[
        Path | None, typer.Option(help="another model folder, to be compared on the same pictures", file_okay=False)
    ] = None,
    quick: Annotated[bool, typer.Option(help="a few pictures of each set")] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            help="folder for report.html, report.json and pictures; beside/ has the other's",
            file_okay=False,
            writable=True,
        ),
    ] = None,
    update_card: Annotated[bool, typer.Option(help="write the scores into cards and manifests")] = False,
) -> None:
    """Score a model on pictures that no training saw, beside the best constant depth of each picture."""
    with _training_parts():
        from model_export import tables
        from model_export.evaluate import evaluate as run_evaluation
        from model_export.evaluation_sets import FOLDERS, evaluation_sets

    models = [model] if beside is None else [model, beside]
    with _plain_failures():
        for folder in models:
            load_model_folder(folder)
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
        with Console(stderr=True).status("reading pictures"):
            sets = evaluation_sets(data, quick)
    if missing := [name for name in FOLDERS if not any(each.name.startswith(name) for each in sets)]:
        typer.secho(f"{data} has no pictures of {', '.join(missing)}: without them", err=True)
    with progress_bar() as progress, _plain_failures():
        task = progress.add_task("loading", total=len(sets))
        found = run_evaluation(
            models, sets, lambda said, finished: progress.update(task, description=said, advance=finished)
        )
    if empty := {each.name for each in sets} - {found_of.name for found_of in found[0].sets}:
        typer.secho(f"no picture with enough depth to score: without {', '.join(sorted(empty))}", err=True)
    shown = tables.tables(found[0])
    if beside is not None:
        shown |= {f"{found[1].model} beside {found[0].model}": tables.beside(*found)}
    for title, (head, rows) in shown.items():
        print_table(_as_table(title, head, rows))
    with _plain_failures():
        _keep(found, out, models if update_card else [], "camind evaluate --data DATA" + " --quick" * quick)


def _keep(found: "list[Report]", out: Path | None, models: list[Path], command: str) -> None:
    """Write reports into a folder, and what they found into the cards of models."""
    from model_export.card import record_scores
    from model_export.report_page import write
    from model_export.tables import markdown

    if out is not None:
        for report, folder in zip(found, (out, out / "beside"), strict=False):
            write(report, folder)
        typer.echo(out / "report.html")
    for report, folder in zip(found, models, strict=False):
        record_scores(folder, report.scores(), markdown(report), command)


def _as_table(title: str, head: list[str], rows: list[list[str]]) -> Table:
    table = Table(Column(head[0], no_wrap=True), *head[1:], title=title)
    for row in rows:
        table.add_row(*row)
    return table


@bench.callback()
def speed(
    context: typer.Context,
    model: Model = SHIPPED_MODEL,
    rounds: Annotated[int, typer.Option(min=2, help="times that everything is timed, in turns")] = 10,
    seconds: Annotated[float, typer.Option(min=1, help="how long each number of clients asks")] = 10.0,
    out: Annotated[Path | None, typer.Option(help="JSON file to write", dir_okay=False, writable=True)] = None,
) -> None:
    """Time the graphs beside the paper's network, whole requests, and many clients; takes the machine to itself."""
    if context.invoked_subcommand is not None:
        return
    with _training_parts():
        from model_export import bench_speed

    with _plain_failures():
        load_model_folder(model)
        if out is not None:
            out.parent.mkdir(parents=True, exist_ok=True)
    with progress_bar() as progress:
        task = progress.add_task("measuring", total=bench_speed.steps(rounds))
        report = bench_speed.measure(model, rounds, seconds, lambda: progress.advance(task))
    for table in bench_speed.tables(report):
        print_table(table)
    if out is not None:
        out.write_text(json.dumps(asdict(report), indent=2) + "\n")


@bench.command()
def calibration(
    cameras: Annotated[int, typer.Option(min=0, help="random cameras")] = 100,
    pairs: Annotated[int, typer.Option(min=0, help="pairs for each k_cam of the paper; 0: none")] = 20,
    workers: Annotated[int, typer.Option(min=1, max=64, help="processes")] = 2,
) -> None:
    """Calibrate simulated cameras: errors, intervals, and the paper's Fig. 4 by both methods."""
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    with _training_parts():
        from model_export import bench_calibration
        from model_export.devices import one_core

    with (
        progress_bar() as progress,
        ProcessPoolExecutor(workers, get_context("forkserver"), initializer=one_core) as pool,
    ):
        found = list(
            progress.track(pool.map(bench_calibration.random_camera, range(cameras)), cameras, description="cameras")
        )
        if found:
            print_table(bench_calibration.error_table(found))
        if pairs:
            numbers = bench_calibration.PAPER_NUMBERS
            results = pool.map(bench_calibration.paper_pairs, numbers, [pairs] * len(numbers))
            table = Table(*bench_calibration.PAPER_HEAD, title=f"{pairs} pairs at half the focus distance")
            for number, both in zip(numbers, progress.track(results, len(numbers), description="pairs"), strict=True):
                for method, trial in both:
                    table.add_row(*bench_calibration.paper_row(number, method, trial))
            print_table(table)


@commands.command()
def blender(
    out: Annotated[Path, typer.Option(help="folder of the set, e.g. DATA/blender", file_okay=False)],
    scenes: Annotated[int, typer.Option(min=1, max=1000, help="rooms to render")] = 200,
    environment: Annotated[Path, typer.Option(help="Blender's own environment, made if missing")] = BLENDER_ENVIRONMENT,
) -> None:
    """Ray-trace thin-lens scenes with exact depth, and compare our renderer's edges with Cycles'."""
    with _training_parts():
        from model_export.datasets import blender as cycles
        from model_export.datasets import blender_environment

    edges, rooms = cycles.edges(), cycles.rooms(scenes)
    raw = out / "raw"
    with _plain_failures(), progress_bar() as progress:
        task = progress.add_task("Blender", total=None)
        python = blender_environment.environment(environment)
        progress.update(task, description="rendering", total=len(edges) + len(rooms))
        cycles.render(python, [*edges, *rooms], raw, lambda _: progress.advance(task))
        progress.update(task, description="developing")
        cycles.develop(raw, rooms, out)
    table = Table("edge", "sigma px", "Cycles", "ours", "ours / Cycles")
    worst = 0.0
    for result in cycles.compare_edges(raw, edges):
        ratio = result.ours_px / result.cycles_px
        worst = max(worst, abs(ratio - 1))
        table.add_row(result.name, *(f"{v:.3f}" for v in (result.expected_px, result.cycles_px, result.ours_px, ratio)))
    print_table(table)
    if worst > cycles.EDGE_TOLERANCE:
        raise _fail(f"ours and Cycles differ by {worst:.1%}, more than {cycles.EDGE_TOLERANCE:.0%}")


@commands.command()
def homes(
    out: Annotated[Path, typer.Option(help="folder of the frames, for train --frames", file_okay=False)],
    furniture: Annotated[
        Path, typer.Option(help="folder of *.sh3f libraries (Debian's sweethome3d-furniture)", exists=True)
    ],
    textures: Textures,
    rooms: Annotated[int, typer.Option(min=1, max=100_000, help="rooms to render, eight views of each")] = 100,
    environment: Annotated[Path, typer.Option(help="Blender's own environment, made if missing")] = BLENDER_ENVIRONMENT,
) -> None:
    """Ray-trace furnished rooms, sharp and with depth, to train on; stop and start it as you like."""
    with _training_parts():
        from model_export.datasets import blender_environment
        from model_export.datasets import homes as furnished

    with _plain_failures(), progress_bar() as progress:
        task = progress.add_task("Blender", total=None)
        python = blender_environment.environment(environment)
        models = furnished.unpack(furniture, out / "models")
        due = furnished.due(out, rooms)
        progress.update(task, description="rendering", total=len(due) * furnished.VIEWS)
        furnished.render(python, models, textures, due, out, lambda _: progress.advance(task))
    typer.echo(out)


@commands.command()
def data(
    dataset: Annotated[Dataset, typer.Argument(help="whose files they are")],
    source: Annotated[Path, typer.Argument(help="folder of DefocusNet's, or the .h5 or .mat file", exists=True)],
    out: Annotated[Path, typer.Option(help="folder of the set, e.g. DATA/ddff12", file_okay=False)],
) -> None:
    """Turn a dataset of the literature into a folder that evaluate scores: color/, depth/, cameras.json."""
    with _training_parts():
        from model_export.datasets import ddff12, defocusnet, nyu
        from model_export.datasets.photos import save_photos

    photos = {"defocusnet": defocusnet.photos, "ddff12": ddff12.photos, "nyu": nyu.photos}[dataset]
    with progress_bar() as progress, _plain_failures():
        written = save_photos(out, progress.track(photos(source), total=None, description=dataset))
    typer.echo(f"{out}: {written} pictures")
