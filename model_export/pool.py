"""Scenes to batches: they flow through a pool, and batches are drawn from it.

Which scenes are in the pool at a step follows from the step alone, never from timing, so a run with one seed
is one run, however fast the scene workers are and however often it is stopped.
"""

import math
import os
import signal
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from queue import Queue
from threading import Thread

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from model_export.config import MOST_SEED, UNCHANGED, SceneConfig, TrainConfig
from model_export.darkroom import photograph
from model_export.devices import new_stream, one_core, sent
from model_export.losses import UPRIGHT, UPSIDE_DOWN, Batch, Mirror
from model_export.noise_filter import filtered
from model_export.scenes import Material, Negative, Sample, Shot, draw_negative, draw_sample

FOCAL_UNKNOWN_SHARE = 0.3
LEAST_CONTRAST = 0.15  # of a faded picture, as a part of what it had
LEAST_LIGHT = 0.2  # of a dimmed one
# a camera known by its specs has a guess for gamma: mostly too low a one, since motion, haze and filters add softness
GUESSED_GAMMA_SHARE, GUESSED_GAMMA = 0.6, (-0.2, 0.35)  # mean and standard deviation of the guess's log error
FILTERED = 1  # beside a scene's seed
HELD_OUT_SEED = (MOST_SEED + 1) * 2**32
AHEAD = 64
STOPS = (signal.SIGINT, signal.SIGTERM)

Drawn = Sample | Negative


class SceneStream(Dataset[Drawn]):
    """Scene number ``start + i`` of a run, drawn in a worker process: its picture, or the scene itself."""

    def __init__(self, config: TrainConfig, material: Material, start: int, end: int) -> None:
        self.config, self.material = config, material
        self.start, self.end = start, end

    def __len__(self) -> int:
        return self.end - self.start

    def __getitem__(self, index: int) -> Drawn:
        seed = self.config.seed * 2**32 + self.start + index
        if self.config.retaken:
            return draw_negative(seed, self.config.scenes, self.material)
        sample = draw_sample(seed, self.config.scenes, self.material)
        rng = np.random.default_rng((seed, FILTERED))
        if rng.random() >= self.config.filtered_share:
            return sample
        shown = filtered(rng, torch.from_numpy(sample.image)[None].float() / 255)[0]
        return replace(sample, shown=(shown * 255).round().byte().numpy())


def _worker_start(_: int) -> None:
    one_core()
    os.nice(19)  # steps come first where cores are shared
    for number in STOPS:  # whoever stops a run stops its steps, which then save what they did
        signal.signal(number, signal.SIG_IGN)


def scene_stream(config: TrainConfig, material: Material, start: int, end: int, workers: int) -> Iterator[Drawn]:
    """Scenes ``start`` to ``end`` in order, drawn ahead by worker processes (0: in this one)."""
    stream = SceneStream(config, material, start, end)
    loader: DataLoader[Drawn] = DataLoader(
        stream,
        batch_size=None,
        num_workers=workers,
        worker_init_fn=_worker_start,
        prefetch_factor=max(8, 64 // workers) if workers else None,
        multiprocessing_context="forkserver" if workers else None,
    )
    return iter(loader)


def arriving(stream: Iterator[Drawn], device: torch.device) -> Iterator[Drawn]:
    """The stream, its scenes on a CUDA device: brought there by a thread of its own, some ahead, beside all else."""
    waiting: Queue[Drawn | Exception | None] = Queue(AHEAD)

    def bring() -> None:
        beside = new_stream(device)
        try:
            with torch.cuda.stream(beside):
                for drawn in stream:
                    moved = replace(drawn, surfaces=drawn.surfaces.to(device)) if isinstance(drawn, Negative) else drawn
                    beside.synchronize()
                    waiting.put(moved)
            waiting.put(None)
        except Exception as exc:
            waiting.put(exc)

    Thread(target=bring, daemon=True).start()
    while (drawn := waiting.get()) is not None:
        if isinstance(drawn, Exception):
            raise drawn
        if isinstance(drawn, Negative):
            drawn.surfaces.record_stream(torch.cuda.current_stream(device))
        yield drawn


class Pool:
    """The last ``pool`` scenes of the stream; ``fresh_per_step`` new ones come in after every batch, on average."""

    def __init__(self, config: TrainConfig, material: Material, step: int, workers: int, device: str = "cpu") -> None:
        self.config, self.device = config, torch.device(device)
        first = self._drawn(step) - config.pool
        stream = scene_stream(config, material, first, self._drawn(config.steps) + 1, workers)
        self.stream = arriving(stream, self.device) if self.device.type == "cuda" else stream
        self.samples: deque[Drawn] = deque(maxlen=config.pool)

    def _drawn(self, step: int) -> int:
        """How many scenes have come in before ``step``: a full pool first, then the steady flow."""
        return self.config.pool + int(step * self.config.fresh_per_step)

    def fill(self) -> Iterator[int]:
        """Bring the pool to its state at the first step, one scene at a time."""
        for number in range(self.config.pool):
            self.samples.append(next(self.stream))
            yield number

    def batch(self, step: int) -> Batch:
        """The batch of a step: scenes, flips, hints and all follow from seed and step."""
        rng = np.random.default_rng((self.config.seed, step))
        chosen = [self.samples[i] for i in rng.integers(0, len(self.samples), self.config.batch)]
        negatives = [drawn for drawn in chosen if isinstance(drawn, Negative)]
        if negatives:
            return collate_retaken(negatives, rng, self.config, self.device)
        return collate([drawn for drawn in chosen if isinstance(drawn, Sample)], rng, self.config)

    def settling(self) -> Iterator[Batch]:
        """Batches of the pool as it is that no step draws, for batch norms to settle on."""
        return (self.batch(self.config.steps + i) for i in range(self.config.settle_batches))

    def refresh(self, step: int) -> None:
        """Let in the new scenes that come after this step; as many old ones go."""
        for _ in range(self._drawn(step), self._drawn(step + 1)):
            self.samples.append(next(self.stream))


class Pools:
    """A pool, and one of larger pictures where some steps have those: which is a step's follows from its number."""

    def __init__(self, config: TrainConfig, material: Material, step: int, workers: int, device: str = "cpu") -> None:
        self.large_share = config.large_share
        configs = [config, config.enlarged()] if config.large_share else [config]
        own = -(-workers // len(configs))
        self.pools = [Pool(each, material, step, own, device) for each in configs]
        self.size = sum(each.pool for each in configs)

    def fill(self) -> Iterator[int]:
        """Bring the pools to their state at the first step, one scene at a time."""
        return (number for pool in self.pools for number in pool.fill())

    def batch(self, step: int) -> Batch:
        """The batch of a step."""
        is_large = int((step + 1) * self.large_share) > int(step * self.large_share)
        return self.pools[is_large].batch(step)

    def settling(self) -> Iterator[Batch]:
        """Batches that no step draws, for batch norms to settle on: not of larger pictures."""
        return self.pools[0].settling()

    def refresh(self, step: int) -> None:
        """Let in the new scenes that come after this step."""
        for pool in self.pools:
            pool.refresh(step)


def collate(samples: list[Sample], rng: np.random.Generator, config: TrainConfig = UNCHANGED) -> Batch:
    """Samples to tensors, flipped and turned at random, focal length shown or not, gamma told or guessed.

    Most are left upright: below is nearer, as in most photographs. A side is asked for at times, of scenes on both
    sides either: a near thing may stand before a far background.
    """
    pictures, excesses, told = [], [], []
    for sample in samples:
        turns, flip = _turn(rng, config)
        both = np.stack([sample.image, sample.image if sample.shown is None else sample.shown])
        pictures.append(np.rot90(both, turns, (2, 3))[..., ::flip].copy())
        excesses.append(np.rot90(sample.excess, turns)[:, ::flip].astype(np.float32))
        told.append(_told(rng, sample.shot, config))
    image, shown = (torch.from_numpy(np.stack(pictures)).float() / 255).unbind(1)
    return _batch(rng, config, (image, shown), torch.from_numpy(np.stack(excesses))[:, None], told)


def collate_retaken(
    negatives: Sequence[Negative], rng: np.random.Generator, config: TrainConfig, device: torch.device
) -> Batch:
    """The same of pictures that are taken now, on the device."""
    with torch.autocast(device.type, enabled=False):
        image, excess, shots = photograph(rng, negatives, config, device)
    turns, flips = zip(*(_turn(rng, config) for _ in negatives), strict=True)
    both = torch.cat([image, excess], 1)
    for turn in (1, 2, 3):
        chosen = sent(np.flatnonzero(np.array(turns) == turn), device)
        both[chosen] = torch.rot90(both[chosen], turn, (2, 3))
    flipped = sent(np.array(flips) < 0, device)[:, None, None, None]
    both = torch.where(flipped, both.flip(3), both)
    image, excess = both[:, :3], both[:, 3:]
    shown = image
    if (items := np.flatnonzero(rng.random(len(shots)) < config.filtered_share)).size:
        chosen = sent(items, device)
        shown = image.index_copy(0, chosen, filtered(rng, image[chosen]))
    return _batch(rng, config, (image, shown), excess, [_told(rng, shot, config) for shot in shots])


def _turn(rng: np.random.Generator, config: TrainConfig) -> tuple[int, int]:
    """How many quarters a picture is turned, and -1 if it is mirrored."""
    return int(rng.integers(4)) if rng.random() < config.turned_share else 0, int(rng.choice([-1, 1]))


def _told(rng: np.random.Generator, shot: Shot, config: TrainConfig) -> dict[str, float]:
    """A shot as a batch has it, by the names there: what of its camera is known, guessed or asked for."""
    focal = 0.0 if rng.random() < FOCAL_UNKNOWN_SHARE else shot.focal_length_px
    side = (shot.side or int(rng.choice([-1, 1]))) if rng.random() < config.hint_share else 0
    guess = math.exp(rng.normal(*GUESSED_GAMMA)) if rng.random() < GUESSED_GAMMA_SHARE else 1.0
    return {
        "k_cam_px": shot.k_cam_px,
        "gamma_px": shot.gamma_px,
        "told_gamma_px": guess * shot.gamma_px,
        "focus_distance_m": shot.focus_distance_m,
        "focal_length_px": focal,
        "side": side,
    }


def _left(rng: np.random.Generator, count: int, share: float, least: float) -> NDArray[np.float32]:
    """What is left of 1 [n], in that share of the pictures: at least so much, all orders of magnitude alike."""
    return np.where(rng.random(count) < share, least ** rng.random(count), 1).astype(np.float32)


def _worn(rng: np.random.Generator, shown: Tensor, config: TrainConfig) -> Tensor:
    """Pictures [n,3,h,w], some with less contrast or light, in steps of a grey level again."""
    left = ((config.faded_share, LEAST_CONTRAST), (config.dimmed_share, LEAST_LIGHT))
    told = torch.from_numpy(np.stack([_left(rng, len(shown), *each) for each in left]))
    contrast, light = sent(told, shown.device)[:, :, None, None, None]
    mean = shown.mean((2, 3), keepdim=True)
    levels = (light * (mean + contrast * (shown - mean)) * 255).round()
    return torch.where(contrast * light < 1, levels / 255, shown)


def _batch(
    rng: np.random.Generator,
    config: TrainConfig,
    pictures: tuple[Tensor, Tensor],
    excess: Tensor,
    told: Sequence[dict[str, float]],
) -> Batch:
    """A batch of pictures as teachers are to see them, and as what learns is, before these wear."""
    image, shown = pictures[0], _worn(rng, pictures[1], config)
    numbers = torch.tensor([[*each.values()] for each in told], dtype=torch.float32)
    columns = dict(zip(told[0], sent(numbers, image.device).unbind(1), strict=True))
    place = (rng.random(), rng.random())
    mirrors: tuple[Mirror, ...] = UPRIGHT + UPSIDE_DOWN
    if not config.all_mirrors:  # on two cores all four cost teachers more than the step itself
        mirrors = (UPRIGHT[rng.integers(2)], UPSIDE_DOWN[rng.integers(2)])
    image, shown = (maps.contiguous(memory_format=torch.channels_last) for maps in (image, shown))
    return Batch(image, shown, excess, **columns, place=place, mirrors=mirrors)


def held_out(scenes: SceneConfig, material: Material, numbers: Iterable[int]) -> Batch:
    """Scenes of seeds no training draws, as one batch."""
    samples = [draw_sample(HELD_OUT_SEED + i, scenes, material) for i in numbers]
    return collate(samples, np.random.default_rng(HELD_OUT_SEED))
