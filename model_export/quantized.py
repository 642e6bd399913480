"""The pair in int8: U8S8, per channel; front ends, what sees their energies, and the last convolutions stay in float32.

Weights have seven bits (``reduce_range``), because AVX2 without integer dot products adds pairs of products in sixteen.
"""

import copy
import logging
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnxruntime.quantization import QuantFormat, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process
from torch import Tensor, nn
from torch.nn import functional

from model_export.config import SceneConfig
from model_export.export import export_graphs, finish
from model_export.networks import Pair
from model_export.scenes import draw_sample
from model_export.verify import CAMERA, through_torch
from service.inference.artifact import GraphFile, Graphs, sha256_of

SCENES = 48
FIRST_SEED = 2**41  # neither a training's nor a held-out scene's
QUANTISED = ("Conv", "Relu", "MaxPool", "Resize", "Add")
FIRST = "network.unet.encoder.0.layers.0."
IMAGE = "unet.encoder.0.layers.0.ways.0"
ENERGIES = "network.unet.encoder.0.layers.0.ways.1."

Feeds = dict[str, NDArray[np.float32]]


class _Feeds:
    """Feeds one by one, as the quantiser asks for them: its ``CalibrationDataReader``."""

    def __init__(self, feeds: list[Feeds]) -> None:
        self._feeds = iter(feeds)

    def get_next(self) -> Feeds | None:
        return next(self._feeds, None)


class Cells(nn.Module):
    """A picture [n,c,h,w] by the four pixels of its cells of 2x2: [n,4c,h/2,w/2]."""

    pixels: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.register_buffer("pixels", torch.eye(4 * channels).reshape(4 * channels, channels, 2, 2), persistent=False)

    def forward(self, picture: Tensor) -> Tensor:
        return functional.conv2d(picture, self.pixels, stride=2)


def through_cells(pair: Pair) -> Pair:
    """A copy of the compact pair that answers the same: its convolution over every other pixel sees cells of four.

    Of few channels and a large kernel ONNX Runtime's convolution in int8 spends its time on gathering pixels.
    """
    blur = copy.deepcopy(pair.blur)
    over_pixels = blur.get_submodule(IMAGE)
    if isinstance(over_pixels, nn.Conv2d) and over_pixels.stride == (2, 2):
        kernels = functional.pixel_unshuffle(over_pixels.weight.detach(), 2)
        outputs, maps, size, _ = kernels.shape
        over_cells = nn.Conv2d(maps, outputs, size, padding=size // 2, bias=False)
        over_cells.weight = nn.Parameter(kernels)
        blur.set_submodule(IMAGE, nn.Sequential(Cells(over_pixels.in_channels), over_cells))
    return replace(pair, blur=blur)


def quantised_graphs(pair: Pair, folder: Path) -> Graphs:
    """Write both graphs in int8, their ranges taken from generated scenes; what the manifest says of all.

    The layout's own graph, which large pictures alone need, and once, stays as it is.
    """
    with tempfile.TemporaryDirectory() as scratch:
        graphs = export_graphs(through_cells(pair), Path(scratch))
        blur, depth = zip(*_scene_feeds(pair, graphs.feature_names), strict=True)
        if graphs.layout:
            shutil.copy(Path(scratch, graphs.layout.file), folder)
        return Graphs(
            blur=_quantised(graphs.blur, Path(scratch), list(blur), folder, in_float=(ENERGIES,)),
            depth=_quantised(graphs.depth, Path(scratch), list(depth), folder),
            layout=graphs.layout,
        )


def _scene_feeds(pair: Pair, feature_names: tuple[str, ...]) -> Iterator[tuple[Feeds, Feeds]]:
    """What the blur graph and the depth graph are given for generated scenes."""
    for number in range(SCENES):
        sample = draw_sample(FIRST_SEED + number, SceneConfig())
        image = sample.image[None].astype(np.float32) / np.float32(255)
        camera = {name: getattr(sample.shot, name) for name in CAMERA}
        yield {"image": image}, through_torch(pair, image, camera, feature_names)[1]


def _quantised(
    graph: GraphFile, scratch: Path, feeds: list[Feeds], folder: Path, in_float: tuple[str, ...] = ()
) -> GraphFile:
    prepared = scratch / f"prepared-{graph.file}"
    quant_pre_process(scratch / graph.file, prepared, skip_symbolic_shape=True)
    level = logging.root.level
    logging.root.setLevel(logging.ERROR)  # it warns of what has been done
    try:
        quantize_static(
            prepared,
            folder / graph.file,
            _Feeds(feeds),
            quant_format=QuantFormat.QDQ,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            per_channel=True,
            reduce_range=True,
            nodes_to_quantize=_from_first_to_last(onnx.load(prepared), in_float),
        )
    finally:
        logging.root.setLevel(level)
    finish(folder / graph.file)
    return graph.model_copy(update={"sha256": sha256_of(folder / graph.file)})


def _from_first_to_last(model: onnx.ModelProto, in_float: tuple[str, ...]) -> list[str]:
    """Nodes from the first convolution of the network up to its last, but for that one and those named."""
    nodes = list(model.graph.node)
    kernels = {i: node.input[1] for i, node in enumerate(nodes) if node.op_type == "Conv"}
    first = min(i for i, name in kernels.items() if name.startswith(FIRST))
    left = {nodes[i].name for i, name in kernels.items() if name.startswith(in_float)}
    inner = nodes[first : max(kernels)]
    return [node.name for node in inner if node.op_type in QUANTISED and node.name not in left]
