"""``camind bench``: graphs, service and machine measured in one run, as tables and as JSON."""

import platform
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import onnxruntime
import torch
from rich.table import Table

from model_export import bench_graphs, bench_seams, bench_service
from model_export.bench_graphs import SIZE, THREADS, NetworkRow, Rate, SizeRow, Timing
from model_export.bench_seams import SeamRow
from model_export.bench_service import LoadRow, RequestRow
from model_export.started_server import serving
from service.inference.artifact import load_model_folder

LARGE_ROUNDS = 3


@dataclass(frozen=True, slots=True)
class SpeedReport:
    """Everything one run measured. ``gigaflops`` is what both graphs compute for a 640x480 picture."""

    model: str
    machine: dict[str, str]
    gigaflops: dict[str, float]
    networks: list[NetworkRow]
    rates: list[Rate]
    sizes: list[SizeRow]
    seams: list[SeamRow]
    requests: list[RequestRow]
    load: list[LoadRow]
    peak_memory_mb: dict[str, float]

    def share_of_machine(self, row: NetworkRow) -> float:
        """What the graphs compute in a second over the best rate of any library with such numbers and threads."""
        alike = (rate for rate in self.rates if (rate.numbers, rate.threads) == (row.numbers, row.threads))
        best = max(rate.giga_per_second for rate in alike)
        return self.gigaflops[row.network] / row.timing.median_s / best


def measure(model: Path, rounds: int, seconds: float, on_step: Callable[[], None]) -> SpeedReport:
    """Measure everything; each number of clients asks for ``seconds``. ``on_step`` is called ``steps`` times."""
    manifest = load_model_folder(model).manifest
    with tempfile.TemporaryDirectory() as scratch:
        networks = bench_graphs.time_networks(model, Path(scratch), rounds, on_step)
    rates = [rate for threads in THREADS for rate in bench_graphs.machine_rates(threads, LARGE_ROUNDS, on_step)]
    sizes = bench_graphs.time_sizes(model, LARGE_ROUNDS, on_step)
    seams = bench_seams.compare(model, on_step)
    memory = {}
    with tempfile.TemporaryDirectory() as folder, serving(Path(folder) / "data", "--model", model.absolute()) as server:
        frame = bench_service.time_frames(server, rounds, on_step)
        memory["640x480 frames"] = server.peak_memory_bytes / 1e6
        load = bench_service.time_load(server, seconds, on_step)
        memory["many clients"] = server.peak_memory_bytes / 1e6
        large = bench_service.time_photographs(server, LARGE_ROUNDS, on_step)
        memory["12-megapixel photographs"] = server.peak_memory_bytes / 1e6
    return SpeedReport(
        model=manifest.name,
        machine={
            "processor": platform.processor() or platform.machine(),
            "float32 path": torch.backends.cpu.get_cpu_capability(),
            "torch": torch.__version__,
            "onnxruntime": onnxruntime.__version__,
        },
        gigaflops={
            "paper": bench_graphs.graph_flops("paper", *SIZE) / 1e9,
            "camind": bench_graphs.graph_flops(manifest.kind, *SIZE) / 1e9,
        },
        networks=networks,
        rates=rates,
        sizes=sizes,
        seams=seams,
        requests=[frame, *large],
        load=load,
        peak_memory_mb=memory,
    )


def steps(rounds: int) -> int:
    """How often ``measure`` tells of progress."""
    graphs = len(THREADS) * (rounds + 1) + (len(THREADS) + 1) * (LARGE_ROUNDS + 1)
    return graphs + bench_seams.PICTURES + 1 + len(bench_service.CLIENTS) + len(bench_service.PHOTOGRAPHS_K_CAM_PX)


def tables(report: SpeedReport) -> list[Table]:
    """The report for a terminal."""
    return [_networks(report), _rates(report), _sizes(report), _seams(report), _requests(report), _load(report)]


def _ms(timing: Timing) -> str:
    return f"{1e3 * timing.median_s:,.1f} ± {100 * timing.spread:.0f} %"


def _networks(report: SpeedReport) -> Table:
    head = (
        "640x480",
        "numbers",
        "threads",
        "ms",
        "times paper, PyTorch",
        "times paper, ONNX Runtime",
        "of the machine's best",
    )
    table = Table(*head, title="Networks")
    for row in report.networks:
        ratios = (f"{row.faster_than_eager:.1f}", f"{row.faster_than_runtime:.1f}")
        table.add_row(
            f"{row.network}, {row.through}",
            row.numbers,
            str(row.threads),
            _ms(row.timing),
            *ratios,
            f"{report.share_of_machine(row):.0%}",
        )
    return table


def _rates(report: SpeedReport) -> Table:
    table = Table("library", "numbers", "threads", "1e9 operations a second", title="What the machine can do")
    for rate in report.rates:
        table.add_row(rate.name, rate.numbers, str(rate.threads), f"{rate.giga_per_second:,.0f}")
    return table


def _sizes(report: SpeedReport) -> Table:
    table = Table("size", "ms", "cost of a pixel", title=f"Sizes, read at full size, {THREADS[-1]} threads")
    for row in report.sizes:
        table.add_row(f"{row.width_px}x{row.height_px}", _ms(row.timing), f"{row.cost_of_a_pixel:.2f}")
    return table


def _seams(report: SpeedReport) -> Table:
    width, height = bench_seams.SIZE
    head = ("tiles", "at borders", "in overlaps", "elsewhere", "the same within 1 %", "largest difference")
    table = Table(*head, title=f"Steps of ln z in tiles of {width}x{height}, over those of pictures read whole")
    for row in report.seams:
        steps = (f"{times:.3f}" for times in (row.borders, row.overlaps, row.elsewhere))
        table.add_row(str(row.tiles), *steps, f"{row.alike:.1%}", f"{row.largest:.1%}")
    return table


def _requests(report: SpeedReport) -> Table:
    stages = list(report.requests[0].stages_ms)
    table = Table("JPEG to 16-bit PNG", "ms", *stages, "all but the graphs", title="Requests over HTTP")
    for row in report.requests:
        told = [f"{row.stages_ms[stage]:,.1f}" for stage in stages]
        table.add_row(row.name, _ms(row.timing), *told, f"{row.around_graphs_ms:,.1f}")
    for what, megabytes in report.peak_memory_mb.items():
        table.add_row(f"peak memory after {what}", f"{megabytes:,.0f} MB")
    return table


def _load(report: SpeedReport) -> Table:
    counts_head = ("clients", "answered", "503", "failed", "per second")
    table = Table(
        *counts_head, "p50 s", "p95 s", "p99 s", "p99 / predicted", "memory MB", title="Many clients, 640x480"
    )
    for row in report.load:
        counts = (str(n) for n in (row.clients, row.answered, row.refused, row.failed))
        times = (f"{s:.2f}" for s in row.percentiles_s.values())
        slowest = f"{row.percentiles_s[99] / row.predicted_s:.2f}"
        table.add_row(*counts, f"{row.per_second:.2f}", *times, slowest, f"{row.memory_mb:,.0f}")
    return table
