"""Torch against ONNX Runtime: a model folder answers as its checkpoint does."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime
import torch
from numpy.typing import NDArray

from model_export.checkpoint import Checkpoint
from model_export.losses import correct
from model_export.networks import Conditioning, LaidOutEstimate, Pair
from service.inference.artifact import BLUR_OUTPUTS, LAYOUT_MAP, LAYOUT_ODDS, load_model_folder

SIZES = ((64, 64), (240, 320), (480, 640))
TOLERANCE = 1e-3
LEAST = 1e-6  # an untrained layout says nothing at all
SEED = 7
CAMERA = {"k_cam_px": 3.81, "gamma_px": 0.5, "focus_distance_m": 2.0, "focal_length_px": 550.0}

Arrays = dict[str, NDArray[np.float32]]


@dataclass(frozen=True, slots=True)
class Difference:
    """The largest |onnx - torch| of an output over its largest |torch|, at one image size."""

    height_px: int
    width_px: int
    graph: str
    output: str
    relative: float


def verify_pair(pair: Pair, folder: Path) -> list[Difference]:
    """Compare every output at three sizes; nothing is judged here."""
    loaded = load_model_folder(folder)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    providers = ["CPUExecutionProvider"]
    blur = onnxruntime.InferenceSession(loaded.blur_graph, options, providers=providers)
    depth = onnxruntime.InferenceSession(loaded.depth_graph, options, providers=providers)
    differences = []
    for height, width in SIZES:
        image = _picture(height, width)
        expected, feeds = through_torch(pair, image, CAMERA, loaded.manifest.graphs.feature_names)
        seen = _run(blur, {"image": image})
        told = _run(depth, feeds | seen)
        of_blur = {name: expected.pop(name) for name in BLUR_OUTPUTS}
        differences += _differences(of_blur, seen, loaded.blur_graph, height, width)
        differences += _differences(expected, told, loaded.depth_graph, height, width)
        if loaded.layout_graph is not None:
            layout = onnxruntime.InferenceSession(loaded.layout_graph, options, providers=providers)
            alone = {LAYOUT_ODDS: expected[LAYOUT_ODDS]}
            differences += _differences(alone, _run(layout, told), loaded.layout_graph, height, width)
    return differences


def _differences(expected: Arrays, got: Arrays, graph: Path, height: int, width: int) -> list[Difference]:
    largest = ((name, np.abs(got[name] - value).max(), np.abs(value).max()) for name, value in expected.items())
    return [Difference(height, width, graph.name, name, float(off / max(most, LEAST))) for name, off, most in largest]


def _picture(height: int, width: int) -> NDArray[np.float32]:
    """Noise that is smooth in some places and rough in others, so that every band has something to say."""
    rng = np.random.default_rng(SEED)
    rough = rng.random((1, 3, height, width), dtype=np.float32)
    return np.asarray(0.5 + (rough - 0.5) * np.linspace(0.02, 1, width, dtype=np.float32), np.float32)


def _run(session: onnxruntime.InferenceSession, feeds: Arrays) -> Arrays:
    names = [output.name for output in session.get_outputs()]
    wanted = {entry.name: feeds[entry.name] for entry in session.get_inputs()}
    return dict(zip(names, session.run(names, wanted), strict=True))


def through_torch(
    pair: Pair, image: NDArray[np.float32], camera: Mapping[str, float], feature_names: tuple[str, ...]
) -> tuple[Arrays, Arrays]:
    """What torch answers for an image [1,3,h,w], and what it fed its depth network, by the graphs' names.

    ``camera`` has the names of ``CAMERA``.
    """
    one = {name: torch.tensor([value]) for name, value in camera.items()}
    conditioning = Conditioning(one["focus_distance_m"], one["focal_length_px"], torch.zeros(1))
    pair.modules().eval()
    with torch.inference_mode():
        seen = pair.blur(torch.from_numpy(image))
        x, spread = correct(seen, one["gamma_px"], one["k_cam_px"], 0.0)
        told = pair.depth(x, spread, conditioning, seen.features)
    features = dict(zip(feature_names, (f.numpy() for f in seen.features), strict=True))
    expected = {
        "blur_px": seen.blur_px.numpy(),
        "blur_log_error": seen.log_error.numpy(),
        "log_ratio_near": told.log_ratio_near.numpy(),
        "log_ratio_far": told.log_ratio_far.numpy(),
        "p_near": torch.sigmoid(told.near_logit).numpy(),
        "log_scale": told.log_scale.numpy(),
    }
    if isinstance(told, LaidOutEstimate):
        expected |= {LAYOUT_MAP: told.layout_map.numpy(), LAYOUT_ODDS: told.layout_odds.numpy()}
    feeds = {
        "relative_defocus": x.numpy(),
        "relative_defocus_spread": spread.numpy(),
        "focus_distance_m": conditioning.focus_distance_m.numpy(),
        "focal_length_px": conditioning.focal_length_px.numpy(),
        "side": conditioning.side.numpy(),
        **features,
    }
    return expected, feeds


def verify_checkpoint(checkpoint: Path, folder: Path) -> list[Difference]:
    """Compare a model folder with the checkpoint it should have come from; ``ValueError`` for one of another kind."""
    pair, kind = Checkpoint.load(checkpoint).pair(), load_model_folder(folder).manifest.kind
    if pair.kind != kind:
        raise ValueError(f"{checkpoint} is a {pair.kind} pair, {folder} a {kind} one")
    return verify_pair(pair, folder)
