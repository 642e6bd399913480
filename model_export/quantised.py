"""The pair in int8: U8S8, per channel; the front end and what sees the picture stay in float32, and so do answers.

Weights have seven bits (``reduce_range``), because AVX2 without integer dot products adds pairs of products in sixteen.
Where int8 and float32 meet, maps are turned round in memory and bytes made numbers, or numbers bytes, each at the price
of a small convolution. So heads, which see one cell each, are products of the numbers as they lie, channels last, and
features go from graph to graph as bytes. Weights make up for what rounding the others does, and biases on average.
"""

import logging
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from onnxruntime import InferenceSession
from onnxruntime.quantization import QuantFormat, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process

from model_export.config import SceneConfig
from model_export.export import feature_names, finish
from model_export.networks import Pair
from model_export.rounded import Seen, rounded
from model_export.scenes import draw_sample
from model_export.verify import CAMERA, through_torch
from service.inference.artifact import GraphFile, Graphs, TensorSpec, load_model_folder, sha256_of

SCENES = 48
FIRST_SEED = 2**41  # neither a training's nor a held-out scene's
MOST_STEPS = 64  # either way: seven bits
QUANTISED = ("Conv", "Relu", "MaxPool", "Resize", "Add")
FIRST_OF_BLUR, FIRST_OF_DEPTH = "network.unet.encoder.0.layers.1.", "network.unet.encoder.0.layers.0."
CHANNELS_LAST, CHANNELS_FIRST = (0, 2, 3, 1), (0, 3, 1, 2)
(FEATURES,) = feature_names(1)

Feeds = dict[str, NDArray[np.float32]]
Means = dict[str, NDArray[np.float32]]


class _Feeds:
    """Feeds one by one, as the quantiser asks for them: its ``CalibrationDataReader``."""

    def __init__(self, feeds: list[Feeds]) -> None:
        self._feeds = iter(feeds)

    def get_next(self) -> Feeds | None:
        return next(self._feeds, None)


def quantised_graphs(pair: Pair, folder: Path, floating: Path) -> Graphs:
    """Write in int8 both graphs of the pair's model folder, ``floating``; what the manifest says of all.

    Their ranges are those of generated scenes. The layout's own graph, which large pictures alone need, and once, stays
    as it is.
    """
    exported = load_model_folder(floating)
    graphs = exported.manifest.graphs
    seen, asked = zip(*_scene_feeds(pair, graphs.feature_names), strict=True)
    blur = _quantised(exported.blur_graph, list(seen), FIRST_OF_BLUR)
    depth = _quantised(exported.depth_graph, list(asked), FIRST_OF_DEPTH)
    if exported.layout_graph:
        shutil.copy(exported.layout_graph, folder)
    for model in (blur, depth):
        _answer_by_cell(model)
    if graphs.feature_names == (FEATURES,):
        _take_bytes(depth, blur)
    return Graphs(
        blur=_written(blur, graphs.blur, folder), depth=_written(depth, graphs.depth, folder), layout=graphs.layout
    )


def _scene_feeds(pair: Pair, feature_names: tuple[str, ...]) -> Iterator[tuple[Feeds, Feeds]]:
    """What the blur graph and the depth graph are given for generated scenes."""
    for number in range(SCENES):
        sample = draw_sample(FIRST_SEED + number, SceneConfig())
        image = sample.image[None].astype(np.float32) / np.float32(255)
        camera = {name: getattr(sample.shot, name) for name in CAMERA}
        yield {"image": image}, through_torch(pair, image, camera, feature_names)[1]


def _quantised(path: Path, feeds: list[Feeds], first: str) -> onnx.ModelProto:
    """A graph in int8 from that layer up to the last convolution, which is not."""
    with tempfile.TemporaryDirectory() as scratch:
        prepared, quantised = Path(scratch, "prepared.onnx"), Path(scratch, "quantised.onnx")
        quant_pre_process(path, prepared, skip_symbolic_shape=True)
        floating = onnx.load(prepared)
        level = logging.root.level
        logging.root.setLevel(logging.ERROR)  # it warns of what has been done
        try:
            quantize_static(
                prepared,
                quantised,
                _Feeds(feeds),
                quant_format=QuantFormat.QDQ,
                activation_type=QuantType.QUInt8,
                weight_type=QuantType.QInt8,
                per_channel=True,
                reduce_range=True,
                nodes_to_quantize=_from_first_to_last(floating, first),
            )
        finally:
            logging.root.setLevel(level)
        model = onnx.load(quantised)
    _make_up(model, floating, feeds)
    return model


def _make_up(model: onnx.ModelProto, floating: onnx.ModelProto, feeds: list[Feeds]) -> None:
    """Have every sum of products answer nearly what it does in float32, and by channel on average just that.

    One convolution after the other, each seeing what those before it answer now: its weights are rounded anew, then its
    bias is changed, which is the empirical bias correction of Nagel et al., Data-Free Quantization Through Weight
    Equalization and Bias Correction (ICCV 2019).
    """
    in_float = {node.name: node for node in floating.graph.node if node.op_type == "Conv"}
    exact, values = (_constants(each) for each in (floating, model))
    wanted = _channel_means(floating, list(in_float.values()), feeds)
    makers = {node.output[0]: node for node in model.graph.node}
    for convolution in [node for node in model.graph.node if node.op_type == "Conv" and node.input[1] in makers]:
        kernels, steps = (values[name] for name in makers[convolution.input[1]].input[:2])
        weights = numpy_helper.to_array(exact[in_float[convolution.name].input[1]]).astype(np.float64)
        by_output, step = weights.reshape(len(weights), -1), numpy_helper.to_array(steps)[:, np.newaxis]
        seen = _seen(model, convolution, feeds)
        whole = rounded(by_output / step, MOST_STEPS, seen.covariances)
        _change(kernels, whole.reshape(weights.shape))
        made = makers.get(convolution.input[2]) if len(convolution.input) == 3 else None
        if made is not None:  # numbers from an int32 bias
            bias, scale = (values[name] for name in made.input[:2])
            _change(bias, (wanted[convolution.name] - whole * step @ seen.means) / numpy_helper.to_array(scale))


def _constants(model: onnx.ModelProto) -> dict[str, TensorProto]:
    return {tensor.name: tensor for tensor in model.graph.initializer}


def _change(tensor: TensorProto, values: NDArray[np.float64]) -> None:
    """Other values for a constant of whole numbers."""
    kind = helper.tensor_dtype_to_np_dtype(tensor.data_type)
    tensor.CopyFrom(numpy_helper.from_array(np.rint(values).astype(kind), tensor.name))


def _seen(model: onnx.ModelProto, convolution: onnx.NodeProto, feeds: list[Feeds]) -> Seen:
    """What a convolution of a graph sees."""
    said = {attribute.name: helper.get_attribute_value(attribute) for attribute in convolution.attribute}
    maps = [each[0] for each in _answers(model, [convolution.input[0]], feeds)]
    return Seen.of(maps, tuple(said["kernel_shape"]), said["dilations"][0], said["pads"][0])


def _channel_means(model: onnx.ModelProto, nodes: list[onnx.NodeProto], feeds: list[Feeds]) -> Means:
    """What nodes of a graph answer, by name: means [c] over pictures and cells."""
    means = [[maps.mean((0, 2, 3)) for maps in each] for each in _answers(model, [n.output[0] for n in nodes], feeds)]
    return {node.name: np.mean(of_one, axis=0) for node, of_one in zip(nodes, zip(*means, strict=True), strict=True)}


def _answers(model: onnx.ModelProto, names: list[str], feeds: list[Feeds]) -> Iterator[list[NDArray[np.float32]]]:
    """What a graph computes under these names, for each of the feeds."""
    watched = onnx.ModelProto()
    watched.CopyFrom(model)
    known = {output.name for output in watched.graph.output}
    watched.graph.output.extend(onnx.ValueInfoProto(name=name) for name in names if name not in known)
    session = InferenceSession(watched.SerializeToString(), providers=["CPUExecutionProvider"])
    return (session.run(names, feed) for feed in feeds)


def _from_first_to_last(model: onnx.ModelProto, first: str) -> list[str]:
    """Nodes from the first convolution whose weights are named so up to the last one, but for that."""
    nodes = list(model.graph.node)
    kernels = {i: node.input[1] for i, node in enumerate(nodes) if node.op_type == "Conv"}
    begin = min(i for i, name in kernels.items() if name.startswith(first))
    return [node.name for node in nodes[begin : max(kernels)] if node.op_type in QUANTISED]


def _answer_by_cell(model: onnx.ModelProto) -> None:
    """Make a head, which sees one cell each, a product of float32 [n,h,w,c], and only its answers maps [n,c,h,w].

    Where its numbers left the graph as features, the bytes do that they are made from.
    """
    graph = model.graph
    values = _constants(model)
    head = [node for node in graph.node if node.op_type == "Conv"][-1]
    numbers = next(node for node in graph.node if node.output[0] == head.input[0])
    weights, bias = (numpy_helper.to_array(values[name]) for name in head.input[1:])
    constants = {"head.weights": np.ascontiguousarray(weights[:, :, 0, 0].T), "head.bias": bias[:, None, None]}
    cells = FEATURES if numbers.output[0] == FEATURES else "head.cells"
    nodes = [
        helper.make_node("Transpose", [numbers.input[0]], [cells], perm=CHANNELS_LAST),
        helper.make_node("DequantizeLinear", [cells, *numbers.input[1:]], ["head.numbers"]),
        helper.make_node("MatMul", ["head.numbers", "head.weights"], ["head.sums"]),
        helper.make_node("Transpose", ["head.sums"], ["head.maps"], perm=CHANNELS_FIRST),
        helper.make_node("Add", ["head.maps", "head.bias"], head.output),
    ]
    at = list(graph.node).index(head)
    after = list(graph.node)[at + 1 :]
    del graph.node[at:]
    graph.node.remove(numbers)
    graph.node.extend([*nodes, *after])
    for name in head.input[1:]:
        graph.initializer.remove(values[name])
    graph.initializer.extend(numpy_helper.from_array(value, name) for name, value in constants.items())


def _take_bytes(depth: onnx.ModelProto, blur: onnx.ModelProto) -> None:
    """Have features go from graph to graph as bytes [n,h,w,c], by the blur graph's scale."""
    made = next(node for node in depth.graph.node if node.input[0] == FEATURES)
    own, others = (_constants(model) for model in (depth, blur))
    for name in made.input[1:]:
        own[name].CopyFrom(others[name])
    made.CopyFrom(helper.make_node("Transpose", [FEATURES], made.output, perm=CHANNELS_FIRST))
    for value in (*blur.graph.output, *depth.graph.input):
        if value.name == FEATURES:
            sizes = [size.dim_param or size.dim_value for size in value.type.tensor_type.shape.dim]
            turned = [sizes[axis] for axis in CHANNELS_LAST]
            value.type.CopyFrom(helper.make_tensor_type_proto(TensorProto.UINT8, turned))


def _written(model: onnx.ModelProto, graph: GraphFile, folder: Path) -> GraphFile:
    """Write a graph; what the manifest says of it, features being as it takes or gives them."""
    path = folder / graph.file
    onnx.save(model, path)
    finish(path)
    inputs, outputs = (
        tuple(_turned(spec) if spec.name == FEATURES else spec for spec in specs)
        for specs in (graph.inputs, graph.outputs)
    )
    return graph.model_copy(update={"sha256": sha256_of(path), "inputs": inputs, "outputs": outputs})


def _turned(spec: TensorSpec) -> TensorSpec:
    return spec.model_copy(update={"shape": tuple(spec.shape[axis] for axis in CHANNELS_LAST)})
