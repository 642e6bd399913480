"""A checkpoint to a model folder: blur.onnx, depth.onnx, layout.onnx, the model card, and last the manifest."""

import logging
import subprocess
import warnings
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeAlias

import onnx
import torch
from torch import Tensor, nn

from model_export.batch_norms import folded
from model_export.card import card_text, sources_of
from model_export.checkpoint import Checkpoint
from model_export.config import SceneConfig, TrainConfig
from model_export.networks import (
    BLUR_BOUNDS_PX,
    MULTIPLE,
    CompactDepth,
    Conditioning,
    Features,
    LaidOutEstimate,
    Pair,
    parameter_count,
)
from service.inference.artifact import (
    BLUR_INPUTS,
    BLUR_OUTPUTS,
    DEPTH_INPUTS,
    DEPTH_OUTPUTS,
    LAYOUT_MAP,
    LAYOUT_ODDS,
    CardFile,
    GraphFile,
    Graphs,
    Interval,
    Manifest,
    Ranges,
    TensorSpec,
    Training,
    load_model_folder,
    sha256_of,
    write_manifest,
)

OPSET = 20
EXAMPLE_SIZE = (64, 96)
CARD = "MODEL_CARD.md"
LICENCES = "LICENCES.md"

Tensors: TypeAlias = "Tensor | tuple[Tensors, ...]"

logging.getLogger("torch.onnx._internal.exporter._registration").setLevel(logging.ERROR)


class _Graph(nn.Module):
    """A network, or a part of one, with inputs and outputs in the graph's order."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network


class _BlurGraph(_Graph):
    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        out = self.network(image)
        return (out.blur_px, out.log_error, *out.features)


class _DepthGraph(_Graph):
    def forward(
        self, defocus: Tensor, spread: Tensor, focus: Tensor, focal: Tensor, side: Tensor, features: Features
    ) -> tuple[Tensor, ...]:
        out = self.network(defocus, spread, Conditioning(focus, focal, side), features)
        layout = (out.layout_map, out.layout_odds) if isinstance(out, LaidOutEstimate) else ()
        return out.log_ratio_near, out.log_ratio_far, torch.sigmoid(out.near_logit), out.log_scale, *layout


class _LayoutGraph(_Graph):
    """What the depth network says of the layout, for a map that is put together of several."""

    def forward(self, layout_map: Tensor) -> tuple[Tensor, ...]:
        return (self.network(layout_map),)


LAYOUT_INPUTS, LAYOUT_OUTPUTS = (LAYOUT_MAP,), (LAYOUT_ODDS,)


def feature_names(count: int) -> tuple[str, ...]:
    return ("features",) if count == 1 else tuple(f"features_{i}" for i in range(count))


def export_graphs(pair: Pair, folder: Path) -> Graphs:
    """Write the graphs for any batch and any size that is a multiple of 16; what the manifest says of them."""
    pair = folded(pair)
    height, width = EXAMPLE_SIZE
    image = torch.rand(2, 3, height, width)
    with torch.no_grad():  # tensors of inference mode cannot be traced but by a slower way
        seen = pair.blur(image)
    names = feature_names(len(seen.features))
    cells = (2, 1, height // pair.stride, width // pair.stride)
    numbers = [torch.ones(2), torch.full((2,), 500.0), torch.zeros(2)]
    inputs = (torch.rand(cells) + 0.1, torch.rand(cells) + 0.1, *numbers, seen.features)
    blur = _write(_BlurGraph(pair.blur), (image,), BLUR_INPUTS, BLUR_OUTPUTS + names, folder / "blur.onnx")
    outputs: tuple[str, ...] = DEPTH_OUTPUTS
    layout = None
    if isinstance(pair.depth, CompactDepth):
        outputs += LAYOUT_INPUTS + LAYOUT_OUTPUTS
        layout_map = torch.rand(2, pair.depth.coarsest, height // MULTIPLE, width // MULTIPLE)
        graph = _LayoutGraph(pair.depth.layout)
        layout = _write(graph, (layout_map,), LAYOUT_INPUTS, LAYOUT_OUTPUTS, folder / "layout.onnx")
    depth = _write(_DepthGraph(pair.depth), inputs, DEPTH_INPUTS + names, outputs, folder / "depth.onnx")
    return Graphs(blur=blur, depth=depth, layout=layout)


def _free_sizes(tensors: Tensors) -> Any:
    """Every input's batch, height and width are free; which sizes belong together is found by tracing."""
    free = torch.export.Dim.DYNAMIC
    if isinstance(tensors, Tensor):
        return {0: free} if tensors.dim() == 1 else {0: free, 2: free, 3: free}
    return tuple(_free_sizes(tensor) for tensor in tensors)


def _flat(tensors: Tensors) -> list[Tensor]:
    if isinstance(tensors, Tensor):
        return [tensors]
    return [flat for tensor in tensors for flat in _flat(tensor)]


def _write(
    graph: nn.Module,
    inputs: tuple[Tensors, ...],
    input_names: tuple[str, ...],
    output_names: tuple[str, ...],
    path: Path,
) -> GraphFile:
    with warnings.catch_warnings():
        # the exporter steps on its own deprecations
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            graph.eval(),
            inputs,
            input_names=input_names,
            output_names=output_names,
            dynamic_shapes=_free_sizes(inputs),
            opset_version=OPSET,
            dynamo=True,
            verbose=False,
        )
    if program is None:
        raise RuntimeError("torch.onnx.export gave no program")
    program.save(path, external_data=False)
    finish(path)
    with torch.inference_mode():
        outputs = graph(*inputs)
    flat = _flat(inputs)
    return GraphFile(
        file=path.name,
        sha256=sha256_of(path),
        inputs=tuple(map(_spec, input_names, flat)),
        outputs=tuple(map(_spec, output_names, outputs)),
    )


def finish(path: Path) -> None:
    """Check a graph's file, and leave out where on whose disk its operators were written, as the exporter notes.

    What is added to an enlarged map is said to be of one size with it, which ONNX Runtime does not see by itself: it
    computes the sum within a convolution then.
    """
    model = onnx.load(path)
    graph = model.graph
    shapes = {value.name: value.type for value in graph.value_info}
    enlarged = {node.output[0] for node in graph.node if node.op_type == "Resize"} & shapes.keys()
    for node in graph.node:
        if node.op_type == "Add" and node.input[0] in enlarged:
            shapes[node.input[1]].CopyFrom(shapes[node.input[0]])
    for part in (model, graph, *graph.node, *graph.value_info, *graph.input, *graph.output, *graph.initializer):
        part.ClearField("metadata_props")
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, path)


def _spec(name: str, tensor: Tensor) -> TensorSpec:
    """Name and shape, with what is free said as ``n``, ``h`` and ``w`` of the image."""
    if tensor.dim() == 1:
        return TensorSpec(name=name, shape=("n",))
    step = EXAMPLE_SIZE[0] // tensor.shape[2]
    part = "" if step == 1 else f"/{step}"
    return TensorSpec(name=name, shape=("n", tensor.shape[1], f"h{part}", f"w{part}"))


def trained_ranges(scenes: SceneConfig) -> Ranges:
    """What the scenes spanned, in the manifest's words."""
    return Ranges(
        blur_px=Interval(max(scenes.gamma_px[0], BLUR_BOUNDS_PX[0]), scenes.defocus_px[1]),
        k_cam_px=Interval(*scenes.k_cam_px),
        focus_distance_m=Interval(*scenes.focus_distance_m),
        focal_length_px=Interval(*scenes.focal_length_px),
        gamma_px=Interval(*scenes.gamma_px),
        depth_ratio=Interval(*scenes.depth_ratio),
    )


def source_commit(folder: Path = Path(__file__).parent) -> str:
    """The commit of the training code, with ``+`` where the tree differs from it; ``unknown`` outside its own git."""

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    try:
        # what is installed may lie in a checkout of something else, whose commit would say nothing of it
        git("ls-files", "--error-unmatch", "--", Path(__file__).name)
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--", ".") else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def export_pair(
    pair: Pair,
    config: TrainConfig,
    steps: int,
    folder: Path,
    name: str | None = None,
    sources: str = "",
    write_graphs: Callable[[Pair, Path], Graphs] = export_graphs,
) -> Manifest:
    """Write a whole model folder for a pair; the manifest comes last and vouches for the rest.

    ``sources`` is what the card says of where the training pictures come from and under which licence.
    """
    folder.mkdir(parents=True, exist_ok=True)
    now = datetime.now(UTC).replace(microsecond=0)
    name = name or f"camind-{pair.kind}-{now:%Y%m%d}"
    graphs = write_graphs(pair, folder)
    ranges = trained_ranges(config.scenes)
    training = Training(commit=source_commit(), steps=steps, config=config.as_dict())
    (folder / CARD).write_text(card_text(name, pair.kind, ranges, training, parameter_count(pair), sources))
    manifest = Manifest(
        name=name,
        kind=pair.kind,
        created_at=now,
        multiple=MULTIPLE,
        stride=pair.stride,
        graphs=graphs,
        ranges=ranges,
        scores={},
        training=training,
        card=CardFile(file=CARD, sha256=sha256_of(folder / CARD)),
    )
    write_manifest(folder, manifest)
    return manifest


def export_checkpoint(
    checkpoint: Path,
    pictures: Iterable[Path],
    folder: Path,
    name: str | None = None,
    write_graphs: Callable[[Pair, Path], Graphs] = export_graphs,
) -> Manifest:
    """Write the model folder of a checkpoint file; the card carries the licences of the folders it was trained with.

    Of a float32 model folder what today's code makes of its weights; of what they were trained with its card tells.
    Raises ``FileNotFoundError`` for a folder of pictures that states no licences.
    """
    loaded = Checkpoint.load(checkpoint)
    if checkpoint.is_dir():
        sources = sources_of(load_model_folder(checkpoint).card())
    else:
        sources = "".join(_licences_of(trained_with) for trained_with in pictures)
    return export_pair(loaded.pair(), loaded.config, loaded.step, folder, name, sources, write_graphs)


def _licences_of(pictures: Path) -> str:
    file = pictures / LICENCES
    if not file.is_file():
        raise FileNotFoundError(f"{pictures} has no {LICENCES}, which the model card states: write one")
    return file.read_text()
