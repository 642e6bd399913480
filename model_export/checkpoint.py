"""What a run leaves: its weights and all that it needs to go on; and networks from a checkpoint or a model folder."""

import pickle
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import torch

from model_export.batch_norms import restored
from model_export.config import Kind, TrainConfig
from model_export.networks import Pair, Widths, make_pair
from service.inference.artifact import load_model_folder


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """Everything a run needs to go on, or an export to make files from."""

    config: TrainConfig
    step: int
    modules: dict[str, Any]
    optimizers: list[dict[str, Any]]

    def save(self, path: Path) -> None:
        """Write whole or not at all."""
        content = {
            "config": self.config.as_dict(),
            "step": self.step,
            "modules": self.modules,
            "optimizers": self.optimizers,
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch = path.with_suffix(".part")
        whole = BytesIO()  # of a full disk torch itself does not say that it is full
        torch.save(content, whole)
        try:
            scratch.write_bytes(whole.getbuffer())
        except OSError as exc:
            scratch.unlink(missing_ok=True)
            raise OSError(f"{path} cannot be written: {exc.strerror}") from exc
        scratch.replace(path)

    @classmethod
    def load(cls, path: Path) -> "Checkpoint":
        """Of a file, or of a float32 model folder; ``ValueError`` for one of another version, or that is none."""
        try:
            content = _as_checkpoint(path) if path.is_dir() else torch.load(path, map_location="cpu", weights_only=True)
            told, step, modules = (content[name] for name in ("config", "step", "modules"))
        except (RuntimeError, EOFError, pickle.UnpicklingError, LookupError, TypeError) as exc:
            raise ValueError(f"{path} is no checkpoint of camind, or is cut off or damaged") from exc
        try:
            config = TrainConfig.from_dict(told)
        except (TypeError, LookupError, AttributeError) as exc:
            raise ValueError(f"{path} was written by another version of camind: {exc}") from exc
        return cls(config, step, modules, content.get("optimizers", []))

    def averaged(self, other: "Checkpoint", share: float = 0.5, part: str = "") -> "Checkpoint":
        """This one with its weights moved by ``share`` towards another run's, one of them trained on from the other.

        Only those of a ``part`` where one is named: ``blur``, ``depth`` or ``depth.layout``.

        Of two such runs the mean is often better than either (Izmailov et al. 2018). A share below 0 goes on past this
        one, away from the other, as a longer run might have; a batch norm's variance no further than to 0. Raises
        ``ValueError`` for networks of another kind or width.
        """
        if other.config.kind != self.config.kind:
            raise ValueError(f"weights of a {self.config.kind} and a {other.config.kind} pair have no mean")
        if Widths.of(other.modules) != Widths.of(self.modules):
            raise ValueError("weights of pairs with other channels have no mean")
        modules = self.modules | {
            name: torch.lerp(own, other.modules[name], share)
            for name, own in self.modules.items()
            if own.is_floating_point() and name.startswith(part)
        }
        modules |= {name: v.clamp_min(0) for name, v in modules.items() if name.endswith("running_var")}
        return replace(self, modules=modules, step=self.step + other.step)

    def pair(self) -> Pair:
        """The networks with this checkpoint's weights, in evaluation mode."""
        pair = make_pair(self.config.kind, Widths.of(self.modules))
        pair.modules().load_state_dict(self.modules)
        pair.modules().eval()
        return pair


def _as_checkpoint(folder: Path) -> dict[str, Any]:
    """What a checkpoint would hold of a model folder, whose batch norms are folded away and wait for statistics."""
    training = load_model_folder(folder).manifest.training
    return {"config": training.config, "step": training.steps, "modules": restored(folder).modules().state_dict()}


def starting_pair(weights: Path, kind: Kind) -> Pair:
    """The networks of a checkpoint, or of a model folder, which may be of another version: its config is not asked for.

    Raises ``ValueError`` for networks of another kind.
    """
    pair = restored(weights) if weights.is_dir() else Checkpoint.load(weights).pair()
    if pair.kind != kind:
        raise ValueError(f"weights of a {pair.kind} pair do not fit a {kind} pair")
    return pair
