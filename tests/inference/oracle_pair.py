"""A real ONNX pair with a known answer: brightness is blur, and blur is depth by the thin lens alone.

The blur graph reads lambda off the grey level (``WHITE_BLUR_PX`` at white, in pixels of the image it is
given), averaged over its stride. The depth graph takes x as it comes: ``ln(1/(1+x))`` near and
``ln(1/(1-x))`` far; red decides the side (``p_near`` is the red level, through the ``features_red`` map).
So a test can say exactly what a photograph must become.
"""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from service.inference.artifact import (
    CardFile,
    GraphFile,
    Graphs,
    Interval,
    Manifest,
    Ranges,
    TensorSpec,
    Training,
    sha256_of,
    write_manifest,
)

WHITE_BLUR_PX = 10.0
RELATIVE_BLUR_ERROR = 0.05
LOG_DEPTH_SCALE = 0.02
STRIDE = 2
MULTIPLE = 16
OPSET = 17
BLUR_RANGE = Interval(0.3, 60.0)


def build_oracle_pair(
    folder: Path,
    stride: int = STRIDE,
    *,
    depth_scale: float = LOG_DEPTH_SCALE,
    blur_range: Interval = BLUR_RANGE,
) -> Path:
    """Write blur.onnx, depth.onnx, MODEL_CARD.md and manifest.json into the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    onnx.save(_blur_graph(stride), folder / "blur.onnx")
    onnx.save(_depth_graph(depth_scale), folder / "depth.onnx")
    (folder / "MODEL_CARD.md").write_text("# Oracle\n\nBrightness is blur. For tests.\n", encoding="utf-8")
    write_manifest(folder, _manifest(folder, stride, blur_range))
    return folder


def brightness_for(blur_px: float) -> int:
    """The grey level 0..255 that the oracle reads as this blur."""
    return round(255 * blur_px / WHITE_BLUR_PX)


def blur_of(brightness: float) -> float:
    """The blur in pixels that the oracle reads off a grey level."""
    return brightness / 255 * WHITE_BLUR_PX


def _manifest(folder: Path, stride: int, blur_range: Interval) -> Manifest:
    return Manifest(
        name="oracle-20260101",
        kind="compact",
        created_at=datetime(2026, 1, 1, tzinfo=UTC),
        multiple=MULTIPLE,
        stride=stride,
        graphs=Graphs(blur=_graph_file(folder / "blur.onnx"), depth=_graph_file(folder / "depth.onnx")),
        ranges=Ranges(
            blur_px=blur_range,
            k_cam_px=Interval(0.5, 12),
            focus_distance_m=Interval(0.5, 5),
            focal_length_px=Interval(200, 6000),
            gamma_px=Interval(0.0, 1.5),
        ),
        scores={"abs_rel": 0.0},
        training=Training(commit="0000000", steps=0, config={}),
        card=CardFile(file="MODEL_CARD.md", sha256=sha256_of(folder / "MODEL_CARD.md")),
    )


def _graph_file(path: Path) -> GraphFile:
    graph = onnx.load(path).graph
    return GraphFile(file=path.name, sha256=sha256_of(path), inputs=_specs(graph.input), outputs=_specs(graph.output))


def _specs(values: Any) -> tuple[TensorSpec, ...]:
    return tuple(
        TensorSpec(
            name=value.name,
            shape=tuple(dim.dim_param or dim.dim_value for dim in value.type.tensor_type.shape.dim),
        )
        for value in values
    )


def _value(name: str, *shape: int | str) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)


def _constant(name: str, value: NDArray[np.floating]) -> onnx.TensorProto:
    return numpy_helper.from_array(value.astype(np.float32), name)


def _model(name: str, nodes: Any, inputs: Any, outputs: Any, constants: Any) -> onnx.ModelProto:
    graph = helper.make_graph(nodes, name, inputs, outputs, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=9)
    onnx.checker.check_model(model, full_check=True)
    return model


def _blur_graph(stride: int) -> onnx.ModelProto:
    grey = np.full((1, 3, 1, 1), WHITE_BLUR_PX / 3)
    red = np.array([1.0, 0.0, 0.0]).reshape(1, 3, 1, 1)
    nodes = [
        helper.make_node("AveragePool", ["image"], ["mean"], kernel_shape=[stride] * 2, strides=[stride] * 2),
        helper.make_node("Conv", ["mean", "grey"], ["blur_px"]),
        helper.make_node("Conv", ["mean", "red"], ["features_red"]),
        helper.make_node("Mul", ["blur_px", "zero"], ["nothing"]),
        helper.make_node("Add", ["nothing", "log_error"], ["blur_log_error"]),
    ]
    constants = [
        _constant("grey", grey),
        _constant("red", red),
        _constant("zero", np.zeros(1)),
        _constant("log_error", np.log(np.full(1, RELATIVE_BLUR_ERROR))),
    ]
    outputs = [_value(name, "n", 1, "hs", "ws") for name in ("blur_px", "blur_log_error", "features_red")]
    return _model("blur", nodes, [_value("image", "n", 3, "h", "w")], outputs, constants)


def _depth_graph(depth_scale: float) -> onnx.ModelProto:
    maps = ("relative_defocus", "relative_defocus_spread", "features_red")
    numbers = ("focus_distance_m", "focal_length_px", "side")
    nodes = [
        helper.make_node("Add", ["relative_defocus", "one"], ["nearer"]),
        helper.make_node("Log", ["nearer"], ["log_nearer"]),
        helper.make_node("Neg", ["log_nearer"], ["log_ratio_near"]),
        helper.make_node("Min", ["relative_defocus", "almost_one"], ["capped"]),
        helper.make_node("Sub", ["one", "capped"], ["farther"]),
        helper.make_node("Log", ["farther"], ["log_farther"]),
        helper.make_node("Neg", ["log_farther"], ["log_ratio_far"]),
        helper.make_node("Identity", ["features_red"], ["p_near"]),
        helper.make_node("Mul", ["relative_defocus_spread", "zero"], ["nothing"]),
        helper.make_node("Add", ["nothing", "log_scale_value"], ["log_scale"]),
    ]
    constants = [
        _constant("one", np.ones(1)),
        _constant("almost_one", np.full(1, 0.999)),
        _constant("zero", np.zeros(1)),
        _constant("log_scale_value", np.log(np.full(1, depth_scale))),
    ]
    inputs = [_value(name, "n", 1, "h", "w") for name in maps] + [_value(name, "n") for name in numbers]
    names = ("log_ratio_near", "log_ratio_far", "p_near", "log_scale")
    return _model("depth", nodes, inputs, [_value(name, "n", 1, "h", "w") for name in names], constants)
