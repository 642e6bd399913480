"""Export: the files answer as torch does, and the folder vouches for them."""

import subprocess
from functools import partial
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from numpy.typing import NDArray
from typer.testing import CliRunner

from model_export import quantised
from model_export.card import record_scores
from model_export.cli import commands
from model_export.config import Kind, SceneConfig, TrainConfig
from model_export.export import export_pair, source_commit
from model_export.networks import CompactDepth, Pair, make_pair
from model_export.scenes import draw_sample
from model_export.verify import SIZES, TOLERANCE, verify_pair
from service.config import INT8, SHIPPED_MODEL
from service.inference.artifact import load_model_folder

INT8_TOLERANCE = 0.05
CALIBRATED_ON = 3
KINDS: list[Kind] = ["compact", "paper"]


def untrained(kind: Kind) -> Pair:
    torch.manual_seed(3)
    pair = make_pair(kind)
    for module in pair.modules().modules():
        if isinstance(module, torch.nn.BatchNorm2d):  # as training leaves them: neither 0 nor 1
            module.get_buffer("running_mean").uniform_(-0.1, 0.1)
            module.get_buffer("running_var").uniform_(0.5, 1.5)
    if isinstance(pair.depth, CompactDepth):
        torch.nn.init.normal_(pair.depth.layout.head.weight)
    return pair


def exported_untrained(kind: Kind, folder: Path) -> tuple[Pair, Path]:
    pair = untrained(kind)
    export_pair(pair, TrainConfig(kind=kind), 0, folder, sources="- brick: CC0")
    return pair, folder


@pytest.fixture(scope="module")
def compact(tmp_path_factory: pytest.TempPathFactory) -> tuple[Pair, Path]:
    return exported_untrained("compact", tmp_path_factory.mktemp("compact"))


@pytest.fixture(scope="module")
def paper(tmp_path_factory: pytest.TempPathFactory) -> tuple[Pair, Path]:
    return exported_untrained("paper", tmp_path_factory.mktemp("paper"))


@pytest.fixture(scope="module", params=KINDS)
def exported(request: pytest.FixtureRequest) -> tuple[Pair, Path]:
    found: tuple[Pair, Path] = request.getfixturevalue(request.param)
    return found


@pytest.fixture(scope="module")
def in_int8(compact: tuple[Pair, Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[Pair, Path]:
    (pair, floating), folder = compact, tmp_path_factory.mktemp("int8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(quantised, "SCENES", CALIBRATED_ON)
        in_int8 = partial(quantised.quantised_graphs, floating=floating)
        export_pair(pair, TrainConfig(), 0, folder, write_graphs=in_int8)
    return pair, folder


def test_onnx_runtime_answers_as_torch_on_three_sizes(exported: tuple[Pair, Path]) -> None:
    differences = verify_pair(*exported)
    assert {(d.height_px, d.width_px) for d in differences} == set(SIZES)
    assert len({(d.height_px, d.width_px, d.graph, d.output) for d in differences}) == len(differences)
    assert max(d.relative for d in differences) <= TOLERANCE


def test_int8_answers_nearly_as_torch_and_computes_in_int8(in_int8: tuple[Pair, Path]) -> None:
    differences = verify_pair(*in_int8)
    assert 0 < max(d.relative for d in differences if d.output == "blur_px") < INT8_TOLERANCE
    assert max(d.relative for d in differences if d.output.startswith("log_ratio")) < INT8_TOLERANCE
    folder = load_model_folder(in_int8[1])
    seeing = ("network.front.", "network.unet.encoder.0.layers.0.")
    for graph, may_be_in_float in ((folder.blur_graph, seeing), (folder.depth_graph, ())):
        model = onnx.load(graph)
        made = {name: node.op_type for node in model.graph.node for name in node.output}
        convolutions = [node for node in model.graph.node if node.op_type == "Conv"]
        in_int8_inside = [node for node in convolutions if made.get(node.input[1]) == "DequantizeLinear"]
        in_float = [node.input[1] for node in convolutions if node not in in_int8_inside]
        assert len(in_int8_inside) >= 14
        weights = [tensor for tensor in model.graph.initializer if tensor.data_type == onnx.TensorProto.INT8]
        most = max(np.abs(onnx.numpy_helper.to_array(tensor).astype(int)).max() for tensor in weights)
        assert 2 * 255 * most < 2**15  # AVX2 without integer dot products adds pairs of products in sixteen bits
        assert all(name.startswith(may_be_in_float) for name in in_float)
        (head,) = (tensor for tensor in model.graph.initializer if tensor.name == "head.weights")
        assert head.data_type == onnx.TensorProto.FLOAT


def test_in_int8_features_are_bytes_that_mean_what_torch_sees(in_int8: tuple[Pair, Path]) -> None:
    pair, folder = in_int8[0], load_model_folder(in_int8[1])
    graphs = folder.manifest.graphs
    given, taken = (
        next(spec for spec in specs if spec.name == "features") for specs in (graphs.blur.outputs, graphs.depth.inputs)
    )
    assert given == taken
    assert given.shape == ("n", "h/2", "w/2", 16)
    for name in ("features_scale", "features_zero_point"):
        assert constant(folder.blur_graph, name) == constant(folder.depth_graph, name)
    seen, expected = features_seen(pair, folder.blur_graph, torch.rand(1, 3, 64, 96))
    assert np.abs(seen - expected).mean() < INT8_TOLERANCE * expected.max()


def test_in_int8_scenes_are_seen_on_average_as_in_float32(in_int8: tuple[Pair, Path]) -> None:
    pair, graph = in_int8[0], load_model_folder(in_int8[1]).blur_graph
    off = []
    for number in range(CALIBRATED_ON):
        scene = draw_sample(quantised.FIRST_SEED + number, SceneConfig()).image[np.newaxis]
        seen, expected = features_seen(pair, graph, torch.from_numpy(scene).float() / 255)
        off.append((seen - expected).mean((0, 2, 3)))
    steps = np.mean(off, axis=0) / constant(graph, "features_scale")
    assert np.abs(steps).max() < 0.25  # 1.4 where biases are only rounded


def features_seen(pair: Pair, graph: Path, image: torch.Tensor) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What the numbers mean that a blur graph in int8 answers as features, and what torch sees: both [n, c, h, w]."""
    session = onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])
    (features,) = session.run(["features"], {"image": image.numpy()})
    assert features.dtype == np.uint8
    numbers = (features.astype(np.float32) - constant(graph, "features_zero_point")) * constant(graph, "features_scale")
    with torch.inference_mode():
        (expected,) = pair.blur(image).features
    return numbers.transpose(0, 3, 1, 2), expected.numpy()


def constant(graph: Path, name: str) -> float:
    (found,) = (tensor for tensor in onnx.load(graph).graph.initializer if tensor.name == name)
    return float(onnx.numpy_helper.to_array(found))


def test_verify_notices_other_weights(exported: tuple[Pair, Path]) -> None:
    pair, folder = exported
    torch.manual_seed(4)
    assert max(d.relative for d in verify_pair(make_pair(pair.kind), folder)) > TOLERANCE


def test_the_folder_is_whole_and_small(exported: tuple[Pair, Path]) -> None:
    pair, folder = exported
    manifest = load_model_folder(folder).manifest
    assert manifest.kind == pair.kind
    assert manifest.stride == pair.stride
    assert manifest.training.config["kind"] == pair.kind
    assert sum(f.stat().st_size for f in folder.iterdir()) < 16_000_000


@pytest.mark.parametrize("shipped", [SHIPPED_MODEL, SHIPPED_MODEL / INT8], ids=["shipped", "shipped-int8"])
def test_graphs_name_no_file_of_the_machine_that_made_them(
    exported: tuple[Pair, Path], in_int8: tuple[Pair, Path], shipped: Path
) -> None:
    for folder in (exported[1], in_int8[1], shipped):
        for graph in folder.glob("*.onnx"):
            content = graph.read_bytes()
            assert b'File "' not in content
            assert str(Path(quantised.__file__).parents[1]).encode() not in content


def test_the_card_carries_ranges_licences_and_then_scores(exported: tuple[Pair, Path]) -> None:
    folder = exported[1]
    assert "- brick: CC0" in load_model_folder(folder).card()
    assert ("layout.onnx" in load_model_folder(folder).card()) == (folder / "layout.onnx").is_file()
    record_scores(folder, {"plane.abs_rel": 0.05}, {"Depth": "| a |"}, "camind evaluate")
    after = load_model_folder(folder)
    assert after.manifest.scores == {"plane.abs_rel": 0.05}
    assert "| a |" in after.card()
    assert "Not evaluated" not in after.card()


def test_a_commit_is_named_only_where_the_code_is_in_it(tmp_path: Path) -> None:
    def git(*arguments: str) -> None:
        author = ("-c", "user.name=x", "-c", "user.email=x@example.org", "-c", "commit.gpgsign=false")
        subprocess.run(["git", *author, *arguments], cwd=tmp_path, check=True, capture_output=True)

    assert source_commit(tmp_path) == "unknown"
    git("init")
    git("commit", "--allow-empty", "--message", "another's")
    (tmp_path / "export.py").touch()
    assert source_commit(tmp_path) == "unknown"
    git("add", ".")
    git("commit", "--message", "ours")
    commit = source_commit(tmp_path)
    assert len(commit) == 40
    (tmp_path / "export.py").write_text("changed")
    assert source_commit(tmp_path) == f"{commit}+"


@pytest.mark.parametrize(
    "command", [["export", "--checkpoint", str(SHIPPED_MODEL)], ["bench"]], ids=lambda told: str(told[0])
)
def test_a_place_that_cannot_be_written_to_is_said_before_anything_is_done(tmp_path: Path, command: list[str]) -> None:
    (tmp_path / "file").touch()
    result = CliRunner().invoke(commands, [*command, "--out", str(tmp_path / "file" / "in" / "it")])
    assert result.exit_code == 1
    assert result.stderr.startswith("[Errno 20] Not a directory")
