"""How fast the graphs are beside the paper's network and beside what the machine can do, all in one run.

Everything compared is timed in turns, so that what slows the machine slows all of it; ratios are what to read.
"""

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from threadpoolctl import threadpool_limits
from torch.nn.utils import convert_conv2d_weight_memory_format
from torch.utils.flop_counter import FlopCounterMode

from model_export.batch_norms import folded
from model_export.config import Kind, TrainConfig
from model_export.devices import torch_threads
from model_export.export import export_pair
from model_export.losses import correct
from model_export.networks import Conditioning, Pair, make_pair
from model_export.textures import draw_texture
from service.config import INT8
from service.inference.artifact import load_model_folder
from service.inference.cancellation import Cancellation
from service.inference.estimator import Estimator
from service.inference.pair import GraphPair, Stopwatch
from service.optics.camera import Camera

SIZE = (640, 480)
SIZES = ((320, 240), (640, 480), (1280, 960), (4000, 3000))
NATIVE_K_CAM_PX = 1.3  # a phone's at 12 megapixels
THREADS = (1, 2)
MATRIX = 1024
CONVOLUTION = (64, 120, 160)  # channels, rows, columns
FRAME_K_CAM_PX = 3.81
FLOAT32 = "float32"
SEED = 5

K = TypeVar("K")
Work = Callable[[], object]
Picture = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Timing:
    """Seconds of every round of one thing."""

    seconds: tuple[float, ...]

    @property
    def median_s(self) -> float:
        return statistics.median(self.seconds)

    @property
    def spread(self) -> float:
        """Half the distance between the quartiles, relative to the median; 0 for less than two rounds."""
        if len(self.seconds) < 2:
            return 0.0
        low, _, high = statistics.quantiles(self.seconds, n=4)
        return (high - low) / 2 / self.median_s


def in_turns(works: Mapping[K, Work], rounds: int, on_round: Callable[[], None] = lambda: None) -> dict[K, Timing]:
    """Every work once to warm up, then round by round, one after the other."""
    spent: dict[K, list[float]] = {name: [] for name in works}
    for number in range(rounds + 1):
        for name, work in works.items():
            started = time.perf_counter()
            work()
            if number:
                spent[name].append(time.perf_counter() - started)
        on_round()
    return {name: Timing(tuple(seconds)) for name, seconds in spent.items()}


def draw_picture(width_px: int, height_px: int, seed: int = SEED) -> Picture:
    """A picture uint8 [h, w, 3] of a drawn texture, repeated; that of the first seed has detail everywhere."""
    texture = draw_texture(np.random.default_rng(seed), [], 512)
    tile = (np.clip(texture, 0, 1) * 255).astype(np.uint8)
    repeats = (-(-height_px // 512), -(-width_px // 512), 1)
    return np.ascontiguousarray(np.tile(tile, repeats)[:height_px, :width_px])


def camera_for(width_px: int, height_px: int, k_cam_px: float = FRAME_K_CAM_PX) -> Camera:
    return Camera(width_px, height_px, 2.0, k_cam_px, 0.5)


def _eager(pair: Pair, picture: Picture, layout: torch.memory_format) -> Work:
    convert_conv2d_weight_memory_format(pair.modules().eval(), layout)
    image = (torch.from_numpy(picture).permute(2, 0, 1)[None].float() / 255).contiguous(memory_format=layout)
    gamma, k_cam = torch.tensor([0.5]), torch.tensor([FRAME_K_CAM_PX])
    conditioning = Conditioning(torch.tensor([2.0]), torch.zeros(1), torch.zeros(1))

    def run() -> object:
        with torch.inference_mode():
            seen = pair.blur(image)
            x, spread = correct(seen, gamma, k_cam, 0.0)
            return pair.depth(x, spread, conditioning, seen.features)

    return run


def _through_runtime(folder: Path, picture: Picture, threads: int) -> Work:
    pair = GraphPair(load_model_folder(folder), threads)
    camera = camera_for(picture.shape[1], picture.shape[0])
    return lambda: pair.read(picture, camera, "auto", Cancellation(), Stopwatch())


@dataclass(frozen=True, slots=True)
class NetworkRow:
    """A network (paper, camind) at 640x480 through a library on so many threads, beside the paper's two ways."""

    network: str
    through: str
    numbers: str
    threads: int
    timing: Timing
    faster_than_eager: float
    faster_than_runtime: float


def time_networks(model: Path, scratch: Path, rounds: int, on_round: Callable[[], None]) -> list[NetworkRow]:
    """The paper's network in PyTorch and in ONNX Runtime, and the model's graphs, in int8 too, by threads."""
    picture, papers = draw_picture(*SIZE), scratch / "paper"
    export_pair(make_pair("paper"), TrainConfig(kind="paper"), 0, papers)  # untrained: only its speed is of interest
    eager, runtime = ("paper", "PyTorch", FLOAT32), ("paper", "ONNX Runtime", FLOAT32)
    folders = {FLOAT32: model, INT8: model / INT8}
    rows = []
    for threads in THREADS:
        with torch_threads(threads):
            timings = in_turns(
                {
                    eager: _eager(make_pair("paper"), picture, torch.contiguous_format),
                    ("paper", "PyTorch, channels last", FLOAT32): _eager(
                        make_pair("paper"), picture, torch.channels_last
                    ),
                    runtime: _through_runtime(papers, picture, threads),
                }
                | {
                    ("camind", "ONNX Runtime", numbers): _through_runtime(folder, picture, threads)
                    for numbers, folder in folders.items()
                    if folder.is_dir()
                },
                rounds,
                on_round,
            )
        for way, timing in timings.items():
            ratios = (timings[theirs].median_s / timing.median_s for theirs in (eager, runtime))
            rows.append(NetworkRow(*way, threads, timing, *ratios))
    return rows


def graph_flops(kind: Kind, width_px: int, height_px: int) -> int:
    """Floating-point operations of a pair's convolutions as exported, for one picture."""
    pair = folded(make_pair(kind))
    with FlopCounterMode(display=False) as counter:
        _eager(pair, np.zeros((height_px, width_px, 3), np.uint8), torch.contiguous_format)()
    return int(counter.get_total_flops())


@dataclass(frozen=True, slots=True)
class Rate:
    """What one library reaches with one kind of number on so many threads: 1e9 operations a second."""

    name: str
    numbers: str
    threads: int
    giga_per_second: float


def machine_rates(threads: int, rounds: int, on_round: Callable[[], None] = lambda: None) -> list[Rate]:
    """The best rates of the machine's libraries for products of matrices and for convolutions."""
    rng = np.random.default_rng(SEED)
    a, b = (rng.random((MATRIX, MATRIX), np.float32) for _ in range(2))
    channels, rows, columns = CONVOLUTION
    maps = rng.random((1, channels, rows, columns), np.float32)
    weight = rng.random((channels, channels, 3, 3), np.float32)
    ta, tb, tmaps, tweight = map(torch.from_numpy, (a, b, maps, weight))
    ia, ib = ((x * 100).to(torch.int8) for x in (ta, tb))
    product, convolution = 2 * MATRIX**3, 2 * 9 * channels**2 * rows * columns
    works: dict[tuple[str, str], tuple[int, Work]] = {
        ("NumPy product", FLOAT32): (product, lambda: a @ b),
        ("torch product", FLOAT32): (product, lambda: ta @ tb),
        ("torch product", "bfloat16"): (product, _bfloat16(lambda x, y: x @ y, ta, tb)),
        ("torch product", INT8): (product, lambda: torch._int_mm(ia, ib)),
        ("torch convolution", FLOAT32): (convolution, lambda: torch.conv2d(tmaps, tweight, padding=1)),
        ("torch convolution", "bfloat16"): (
            convolution,
            _bfloat16(lambda x, y: torch.conv2d(x, y, padding=1), tmaps, tweight),
        ),
        ("ONNX Runtime product", FLOAT32): (product, _session(_product_graph(b), {"x": a}, threads)),
        ("ONNX Runtime convolution", FLOAT32): (
            convolution,
            _session(_convolution_graph(weight), {"x": maps}, threads),
        ),
        ("ONNX Runtime convolution", INT8): (
            convolution,
            _session(_integer_convolution_graph(weight), {"x": (maps * 200).astype(np.uint8)}, threads),
        ),
    }
    with torch_threads(threads), threadpool_limits(threads, "blas"), torch.inference_mode():
        timings = in_turns({key: work for key, (_, work) in works.items()}, rounds, on_round)
    return [Rate(*key, threads, operations / min(timings[key].seconds) / 1e9) for key, (operations, _) in works.items()]


def _bfloat16(work: Callable[[torch.Tensor, torch.Tensor], object], *values: torch.Tensor) -> Work:
    first, second = (value.to(torch.bfloat16) for value in values)
    return lambda: work(first, second)


def _session(graph: onnx.GraphProto, feeds: Mapping[str, NDArray[np.generic]], threads: int) -> Work:
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # it would take the others' cores
    session = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    return lambda: session.run(None, feeds)


def _graph(node: onnx.NodeProto, kind: int, **weights: NDArray[np.generic]) -> onnx.GraphProto:
    given = helper.make_tensor_value_info("x", kind, None)
    made = helper.make_tensor_value_info("y", kind, None)
    held = [numpy_helper.from_array(values, name) for name, values in weights.items()]
    return helper.make_graph([node], "rate", [given], [made], held)


def _product_graph(weight: NDArray[np.float32]) -> onnx.GraphProto:
    return _graph(helper.make_node("MatMul", ["x", "w"], ["y"]), TensorProto.FLOAT, w=weight)


def _convolution_graph(weight: NDArray[np.float32]) -> onnx.GraphProto:
    node = helper.make_node("Conv", ["x", "w"], ["y"], pads=[1, 1, 1, 1])
    return _graph(node, TensorProto.FLOAT, w=weight)


def _integer_convolution_graph(weight: NDArray[np.float32]) -> onnx.GraphProto:
    names = ["x", "scale", "zero", "w", "w_scale", "w_zero", "scale", "zero"]
    node = helper.make_node("QLinearConv", names, ["y"], pads=[1, 1, 1, 1])
    return _graph(
        node,
        TensorProto.UINT8,
        w=(weight * 100).astype(np.int8),
        scale=np.array(0.01, np.float32),
        zero=np.array(128, np.uint8),
        w_scale=np.array(0.01, np.float32),
        w_zero=np.array(0, np.int8),
    )


@dataclass(frozen=True, slots=True)
class SizeRow:
    """A whole estimate at one size, with the cost of a pixel relative to one at 640x480."""

    width_px: int
    height_px: int
    timing: Timing
    cost_of_a_pixel: float


def time_sizes(model: Path, rounds: int, on_round: Callable[[], None]) -> list[SizeRow]:
    """From a photograph to a depth map at several sizes, read at full size."""
    estimator = Estimator(GraphPair(load_model_folder(model), THREADS[-1]))

    def estimate(width_px: int, height_px: int) -> Work:
        picture, camera = draw_picture(width_px, height_px), camera_for(width_px, height_px, NATIVE_K_CAM_PX)
        return lambda: estimator.estimate(picture, camera)

    timings = in_turns({size: estimate(*size) for size in SIZES}, rounds, on_round)
    of_a_pixel = {(w, h): timing.median_s / (w * h) for (w, h), timing in timings.items()}
    return [SizeRow(*size, timing, of_a_pixel[size] / of_a_pixel[SIZE]) for size, timing in timings.items()]
