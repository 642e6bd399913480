"""The benchmark of speed, on pictures and matrices so small that it takes seconds."""

import json
from functools import partial
from pathlib import Path

import pytest
from typer.testing import CliRunner

from model_export import bench_graphs, bench_seams, bench_service
from model_export.bench_graphs import Timing, graph_flops, in_turns, machine_rates
from model_export.bench_service import time_load
from model_export.cli import commands
from model_export.started_server import serving


@pytest.fixture
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_graphs, "MATRIX", 24)
    monkeypatch.setattr(bench_graphs, "CONVOLUTION", (8, 12, 16))
    monkeypatch.setattr(bench_graphs, "SIZE", (64, 48))
    monkeypatch.setattr(bench_graphs, "SIZES", ((64, 48), (128, 96)))
    monkeypatch.setattr(bench_seams, "SIZE", (1280, 64))
    monkeypatch.setattr(bench_seams, "BUDGETS", (60_000,))
    monkeypatch.setattr(bench_seams, "PICTURES", 2)
    monkeypatch.setattr(bench_service, "SIZE", (64, 48))
    monkeypatch.setattr(bench_service, "FULL_SIZE", (200, 150))
    monkeypatch.setattr(bench_service, "CLIENTS", (1, 3))


def test_works_take_turns_and_the_first_round_does_not_count() -> None:
    seen: list[str] = []
    timings = in_turns({name: partial(seen.append, name) for name in "ab"}, 3)
    assert "".join(seen) == "ab" * 4
    assert all(len(timing.seconds) == 3 for timing in timings.values())


def test_the_spread_is_half_the_distance_between_quartiles() -> None:
    timing = Timing((1.0, 2.0, 3.0, 4.0, 5.0))
    assert timing.median_s == 3.0
    assert timing.spread == pytest.approx(0.5)
    assert Timing((2.0,)).spread == 0


@pytest.mark.usefixtures("_small")
def test_every_library_has_a_rate() -> None:
    rates = machine_rates(1, 2)
    assert {rate.numbers for rate in rates} == {"float32", "bfloat16", "int8"}
    assert {rate.name.split()[0] for rate in rates} == {"NumPy", "torch", "ONNX"}
    assert all(rate.giga_per_second > 0 for rate in rates)


def test_our_graphs_stay_small() -> None:
    ours, papers = graph_flops("compact", 640, 480), graph_flops("paper", 640, 480)
    assert ours < 12e9
    assert papers > 4 * ours


@pytest.mark.usefixtures("_small")
def test_what_tiles_change_is_told_by_place(tiny_model_dir: Path) -> None:
    (row,) = bench_seams.compare(tiny_model_dir)
    assert row.tiles == 2
    assert row.elsewhere == pytest.approx(1, abs=0.02)
    assert row.borders == pytest.approx(1, abs=0.02)
    assert row.alike > 0.99


@pytest.mark.usefixtures("_small")
def test_clients_are_all_answered(tiny_model_dir: Path, tmp_path: Path) -> None:
    with serving(tmp_path / "data", "--model", tiny_model_dir) as server:
        rows = time_load(server, 0.5)
    assert [row.clients for row in rows] == [1, 3]
    for row in rows:
        assert row.answered > 0
        assert row.failed == 0
        assert row.percentiles_s[50] <= row.percentiles_s[99]
        assert row.memory_mb > 50


@pytest.mark.usefixtures("_small")
def test_the_command_prints_and_writes_what_it_measured(tiny_model_dir: Path, tmp_path: Path) -> None:
    out = tmp_path / "bench.json"
    arguments = ["--model", tiny_model_dir, "--rounds", "2", "--seconds", "1", "--out", out]
    result = CliRunner().invoke(commands, ["bench", *map(str, arguments)])
    assert result.exit_code == 0, result.output
    for said in (
        "paper, PyTorch",
        "camind, ONNX Runtime",
        "cost of a pixel",
        "all but the graphs",
        "p99",
        "peak memory",
    ):
        assert said in result.output
    report = json.loads(out.read_text())
    assert len(report["networks"]) == 8
    for request in report["requests"]:
        stages = request["stages_ms"]
        assert set(stages) == {"decode", "wait", "blur", "correct", "depth", "encode"}
        assert 0 < request["around_graphs_ms"] < 1e3 * max(request["timing"]["seconds"])
    assert [row["clients"] for row in report["load"]] == [1, 3]
