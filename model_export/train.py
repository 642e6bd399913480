"""The training loop: batches of a pool move the weights, and checkpoints resume exactly."""

import signal
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Event, current_thread, main_thread
from typing import Any

import torch
from rich.console import Console
from rich.progress import Progress
from torch import Tensor, nn
from torch.nn.utils import convert_conv2d_weight_memory_format

from model_export.batch_norms import folded, spread_norms
from model_export.checkpoint import Checkpoint, starting_pair
from model_export.config import UNCHANGED, Learning, TrainConfig
from model_export.devices import computes_bfloat16, new_stream, torch_threads
from model_export.frames import load_frames
from model_export.losses import Batch, run_pair, total_loss
from model_export.networks import SHIPPED_WIDTHS, CompactDepth, Pair, Widths, make_pair, with_fresh_decoders
from model_export.optimizers import Optimizers
from model_export.pool import STOPS, Pools, held_out
from model_export.scenes import Material
from model_export.textures import load_photographs
from service.cores import available_cores
from service.terminal import progress_bar

CHECKPOINT, LOG = "checkpoint.pt", "log.txt"
MOST_HELD_OUT = 32


def _learning(pair: Pair, part: Learning) -> nn.ModuleList:
    """What of a pair moves in a run; the rest is held as it is, the layout where it is not what is learned.

    Raises ``ValueError`` for a part that the pair does not have.
    """
    if part == "layout":
        if pair.kind != "compact":
            raise ValueError(f"a {pair.kind} pair has no layout to learn")
        return nn.ModuleList([pair.depth.get_submodule("layout")])
    depth = [child for name, child in pair.depth.named_children() if name != "layout"]
    return nn.ModuleList(depth if part == "depth" else [pair.blur, *depth])


def learning_rate(config: TrainConfig, step: int) -> float:
    """Warm-up, a level stretch, and a straight fall to nothing over the last ``decay_share`` of the steps."""
    left = (config.steps - step) / max(1.0, config.steps * config.decay_share)
    return config.learning_rate * min(1.0, (step + 1) / config.warmup_steps, left)


def emphasis(config: TrainConfig, step: int) -> float:
    """How much more what stands out weighs: less and less, no more once the rate falls or where a run goes on."""
    if config.settled_share == 1:
        return 0.0
    return max(0.0, 1 - step / max(1.0, config.steps * (1 - config.decay_share)))


def settling_step(config: TrainConfig) -> int:
    """The step before which the batch norms' statistics are settled for good."""
    return round(config.steps * (1 - config.settled_share))


class Recorded:
    """What a step does with a batch of one shape, as one CUDA graph."""

    def __init__(self, step: Callable[[Batch, Tensor, Tensor], dict[str, Tensor]], batch: Batch, memory: Any) -> None:
        device = batch.image.device
        self.batch = batch.changed(torch.clone)
        self.weight, self.rate = torch.zeros((), device=device), torch.zeros((), device=device)
        beside, current = new_stream(device), torch.cuda.current_stream(device)
        beside.wait_stream(current)
        with torch.cuda.stream(beside):  # libraries choose their kernels; at a rate of 0 nothing moves
            for _ in range(3):
                step(self.batch, self.weight, self.rate)
        current.wait_stream(beside)
        self.graph = torch.cuda.CUDAGraph()
        # another thread moves scenes to the device meanwhile
        with torch.cuda.graph(self.graph, pool=memory, capture_error_mode="thread_local"):
            self.parts = step(self.batch, self.weight, self.rate)

    def replay(self, batch: Batch, weight: float, rate: float) -> dict[str, Tensor]:
        """The step with another batch; its loss's parts."""
        self.weight.fill_(weight)
        self.rate.fill_(rate)
        for own, other in zip(self.batch.tensors(), batch.tensors(), strict=True):
            own.copy_(other)
        self.graph.replay()
        return {name: part.clone() for name, part in self.parts.items()}


class Trainer:
    """Networks, optimiser and step of one run on one device."""

    def __init__(
        self,
        config: TrainConfig,
        device: str,
        resume: Checkpoint | None = None,
        widths: Widths = SHIPPED_WIDTHS,
    ) -> None:
        torch.manual_seed(config.seed)
        self.config, self.device = config, torch.device(device)
        self.pair = make_pair(config.kind, widths if resume is None else Widths.of(resume.modules))
        self.modules = self.pair.modules().to(self.device)
        convert_conv2d_weight_memory_format(self.modules, torch.channels_last)
        self.learning = _learning(self.pair, config.learning)
        self.modules.requires_grad_(requires_grad=False)
        self.learning.requires_grad_()
        if isinstance(self.pair.depth, CompactDepth):
            self.pair.depth.lays_out = config.learning == "layout"
        self.optimizers = Optimizers(self.modules, config.weight_decay)
        self.teachers: list[Pair] = []
        self.recorded: dict[object, Recorded] = {}
        self.memory = torch.cuda.graph_pool_handle() if self.device.type == "cuda" else None  # one at a time uses it
        self.step, self.is_settled = 0, False
        if resume is not None:
            if not resume.optimizers:
                raise ValueError("this checkpoint has no state to go on from: begin a new run with its --weights")
            self.modules.load_state_dict(resume.modules)
            self.optimizers.load_state_dict(resume.optimizers)
            self.step, self.is_settled = resume.step, resume.step > settling_step(resume.config)

    def begin_with(self, pair: Pair) -> None:
        """Take over other networks' weights."""
        self.modules.load_state_dict(pair.modules().state_dict())

    def learn_from(self, *teachers: Pair) -> None:
        """Have what a batch costs include how far the answers are from the mean of other pairs'.

        Raises ``ValueError`` for shares of other teachers than these.
        """
        shares = self.config.teacher_shares
        if shares and len(shares) != len(teachers):
            raise ValueError(f"{len(shares)} teacher_shares are not those of {len(teachers)} teachers")
        self.teachers = [folded(teacher) for teacher in teachers]
        for teacher in self.teachers:
            convert_conv2d_weight_memory_format(teacher.modules().to(self.device), torch.channels_last)
            if isinstance(teacher.depth, CompactDepth):
                teacher.depth.lays_out = self.config.learning == "layout"  # seen in what learns then alone

    def moved(self, values: Tensor) -> Tensor:
        """To where steps are computed."""
        return values.to(self.device)

    def autocast(self) -> torch.autocast:
        """bfloat16 where the hardware computes it; emulated on an older processor it is ten times slower."""
        return torch.autocast(self.device.type, torch.bfloat16, enabled=computes_bfloat16(self.device))

    def advance(self, batch: Batch) -> dict[str, Tensor]:
        """One optimiser step on a batch; the loss's parts."""
        batch = batch.changed(self.moved)
        self.modules.eval()
        self.learning.train()
        if self.step >= settling_step(self.config):
            for norm in self._norms():
                norm.eval()
        told = emphasis(self.config, self.step), learning_rate(self.config, self.step)
        parts = self._replayed(batch, *told) if self.device.type == "cuda" else self._stepped(batch, *told)
        self.step += 1
        return parts

    def _stepped(self, batch: Batch, weight: float | Tensor, rate: float | Tensor) -> dict[str, Tensor]:
        """Weights a step further, at the rate, by the clipped gradients of a batch's loss; the loss's parts."""
        self.learning.zero_grad(set_to_none=False)  # a recorded step writes them where they are
        with self.autocast():
            loss, parts = total_loss(self.pair, batch, self.config, self.teachers, weight)
        torch.autograd.backward(loss)
        nn.utils.clip_grad_norm_(self.learning.parameters(), self.config.clip_norm)
        self.optimizers.step(rate)
        return parts

    def _replayed(self, batch: Batch, weight: float, rate: float) -> dict[str, Tensor]:
        """The same on a CUDA device, recorded once for each kind of step: its thousands of kernels start as one."""
        norms_move = self.step < settling_step(self.config)
        cell = tuple(int(part * self.pair.stride) for part in batch.place)
        kind = (batch.image.shape, norms_move, cell, batch.mirrors if self.teachers else ())
        if kind not in self.recorded:
            self.recorded[kind] = Recorded(self._stepped, batch, self.memory)
        return self.recorded[kind].replay(batch, weight, rate)

    def _norms(self) -> list[nn.BatchNorm2d]:
        return [m for m in self.learning.modules() if isinstance(m, nn.BatchNorm2d)]

    def settle(self, batches: Iterable[Batch]) -> None:
        """Set every batch norm to the plain mean over batches, seen with the weights as they are now.

        The running averages of training follow the last ten batches, which is noise in large blur.
        """
        norms = self._norms()
        momenta = [norm.momentum for norm in norms]
        self.learning.train()
        for norm in norms:
            norm.reset_running_stats()
            norm.momentum = None
        with torch.no_grad(), self.autocast():
            for batch in batches:
                run_pair(self.pair, batch.changed(self.moved))
        for norm, momentum in zip(norms, momenta, strict=True):
            norm.momentum = momentum

    def validate(self, batch: Batch) -> dict[str, float]:
        """The loss's parts on held-out scenes, networks in evaluation mode."""
        self.modules.eval()
        with torch.inference_mode(), self.autocast():
            _, parts = total_loss(self.pair, batch, self.config, self.teachers)
        return {name: float(part) for name, part in parts.items()}

    def checkpoint(self) -> Checkpoint:
        return Checkpoint(self.config, self.step, self.modules.state_dict(), self.optimizers.state_dict())


def config_of(run: Path, settings: Iterable[str]) -> TrainConfig:
    """That of a run's checkpoint, or of a new run's, but for what is set now, as ``TrainConfig.adjusted`` has it.

    Raises ``ValueError`` for a checkpoint that cannot be read, or a setting that is none.
    """
    path = run / CHECKPOINT
    return (Checkpoint.load(path).config if path.exists() else UNCHANGED).adjusted(settings)


@contextmanager
def _interruptible() -> Iterator[Event]:
    """An event that says that the run was asked to stop (Ctrl-C, SIGTERM): after its step, or, asked again, at once."""
    asked = Event()
    if current_thread() is not main_thread():
        yield asked
        return

    def ask(*_: object) -> None:
        if asked.is_set():
            raise KeyboardInterrupt
        asked.set()

    before = {number: signal.signal(number, ask) for number in STOPS}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class Pace:
    """How fast steps go, and what part of the time they wait for scenes: a starved run says so."""

    def __init__(self) -> None:
        self.started = time.perf_counter()
        self.waited_s = 0.0

    @contextmanager
    def waiting(self) -> Iterator[None]:
        began = time.perf_counter()
        yield
        self.waited_s += time.perf_counter() - began

    def told(self, steps: int, scenes_per_step: float) -> str:
        spent_s = time.perf_counter() - self.started
        pace = steps / spent_s
        return f"{pace:.2f} steps/s, {pace * scenes_per_step:.2f} scenes/s, waited {self.waited_s / spent_s:.0%}"


def train(
    config: TrainConfig,
    textures: Path,
    run: Path,
    *,
    frames: Path | None = None,
    weights: Path | None = None,
    fresh_decoders: bool = False,
    teachers: Sequence[Path] = (),
    workers: int = 1,
    threads: int | None = None,
    device: str = "cpu",
    console: Console | None = None,
) -> Path:
    """Train in folder ``run``, going on from its checkpoint if there is one; the path of the last checkpoint.

    A run without a checkpoint begins with the ``weights`` of a checkpoint or a model folder, or with random ones; with
    ``fresh_decoders`` only with those of the encoders. ``teachers``, checkpoints or folders too, are those whose
    answers, on average, are learned beside the truth. Torch computes on so many ``threads``, by itself on the cores
    that ``workers`` leave; other threads are another run by rounding.
    Raises ``ValueError`` for weights of another kind, for a run with teachers that is gone on with without, and for a
    device that is not there. Where it is interrupted, the run saves what it did and raises ``KeyboardInterrupt``.
    """
    console = console or Console(stderr=True)
    _require_device(device)
    path = run / CHECKPOINT
    with console.status("reading pictures and weights"):
        material = Material(load_photographs(textures), [] if frames is None else load_frames(frames))
        run.mkdir(parents=True, exist_ok=True)
        trainer, start = _opened(config, path, weights, teachers, device, console, fresh_decoders=fresh_decoders)
    config = trainer.config
    if trainer.step == config.steps:
        console.print(f"{run} is at its end: go on with more --steps, or begin a new --run with --weights {path}")
        return path
    pools = Pools(config, material, trainer.step, workers, device)
    # by itself not on a core with a worker: two busy processes there cost each far more than half its speed
    with torch_threads(threads or max(1, available_cores() - workers)), progress_bar(console) as progress:
        numbers = progress.track(range(min(2 * config.batch, MOST_HELD_OUT)), description="held-out scenes")
        test = held_out(config.scenes, material, numbers).changed(trainer.moved)
        for _ in progress.track(pools.fill(), total=pools.size, description="scenes"):
            pass
        if start is not None and weights is not None:
            if weights.is_dir():
                _spread(start, trainer, pools)
            trainer.begin_with(with_fresh_decoders(start) if fresh_decoders else start)
        _step_to_end(trainer, pools, test, path, progress)
    return path


def _step_to_end(trainer: Trainer, pools: Pools, test: Batch, path: Path, progress: Progress) -> None:
    task = progress.add_task("training", total=trainer.config.steps, completed=trainer.step)
    with _interruptible() as asked:
        for said in _steps(trainer, pools, test, path):
            progress.update(task, completed=trainer.step)
            if said is not None:
                progress.console.print(said, soft_wrap=True)
                with (path.parent / LOG).open("a") as log:
                    log.write(f"{said}\n")
            if asked.is_set() and trainer.step < trainer.config.steps:
                raise _stopped(trainer, path, progress.console)


def _stopped(trainer: Trainer, path: Path, console: Console) -> KeyboardInterrupt:
    trainer.checkpoint().save(path)
    console.print(f"stopped after step {trainer.step} of {trainer.config.steps}, which is saved")
    return KeyboardInterrupt()


def _spread(start: Pair, trainer: Trainer, pools: Pools) -> None:
    """Give a model folder's networks, whose batch norms are folded away, such as the run's scenes ask for."""
    start.modules().to(trainer.device)
    spread_norms(start, (partial(run_pair, start, batch.changed(trainer.moved)) for batch in pools.settling()))


def _require_device(name: str) -> None:
    """Raises ``ValueError`` for what torch cannot compute on here."""
    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError) as exc:
        raise ValueError(f"torch does not compute on {name} here: {str(exc).splitlines()[0]}") from exc


def _steps(trainer: Trainer, pools: Pools, test: Batch, path: Path) -> Iterator[str | None]:
    """Take the steps that a run has left, one at a time; what there is to say where a checkpoint was saved."""
    config, pace, due = trainer.config, Pace(), settling_step(trainer.config)
    recent: list[dict[str, Tensor]] = []
    is_settled = trainer.is_settled and trainer.step > due
    while trainer.step < config.steps:
        if trainer.step >= due > 0 and not is_settled:
            trainer.settle(pools.settling())
            is_settled = True
        recent.append(trainer.advance(pools.batch(trainer.step)))
        with pace.waiting():
            pools.refresh(trainer.step - 1)
        if trainer.step % config.checkpoint_every and trainer.step < config.steps:
            yield None
            continue
        trainer.checkpoint().save(path)
        yield _report(trainer, recent, test, pace)
        recent, pace = [], Pace()


def _opened(
    config: TrainConfig,
    path: Path,
    weights: Path | None,
    teachers: Sequence[Path],
    device: str,
    console: Console,
    *,
    fresh_decoders: bool,
) -> tuple[Trainer, Pair | None]:
    """The trainer of a run, as its checkpoint left it if there is one, and the networks that a new run begins with.

    What is set otherwise in a run that is gone on with is said. With such networks the norms' statistics stay as they
    are, but where decoders begin anew, or the layout's part is learned apart: a batch's own would undo much of what
    was learned.
    """
    resume = Checkpoint.load(path) if path.exists() else None
    start = starting_pair(weights, config.kind) if weights is not None and resume is None else None
    config, widths = replace(config, taught=bool(teachers)), SHIPPED_WIDTHS
    if resume is not None:
        _require_onward(config, resume, path.parent)
        changed = config.unlike(resume.config)
        if resume.step < config.steps:
            console.print(f"going on from step {resume.step}" + (f", with {', '.join(changed)}" if changed else ""))
    if start is not None:
        widths = Widths.of(start.modules().state_dict())
        if not fresh_decoders and config.learning != "layout":
            config = replace(config, settled_share=1.0)
    trainer = Trainer(config, device, resume, widths)
    trainer.learn_from(*(starting_pair(teacher, config.kind) for teacher in teachers))
    return trainer, start


def _require_onward(config: TrainConfig, resume: Checkpoint, run: Path) -> None:
    if config.taught != resume.config.taught:
        how = "with" if resume.config.taught else "without"
        raise ValueError(f"{run} was begun {how} a --teacher: go on {how} one")
    if config.kind != resume.config.kind:
        raise ValueError(f"{run} trains a {resume.config.kind} pair, not a {config.kind} one")
    if config.steps < resume.step:
        raise ValueError(f"{run} is at step {resume.step}: it cannot have {config.steps} in all")


def _report(trainer: Trainer, recent: list[dict[str, Tensor]], test: Batch, pace: Pace) -> str:
    """A line on the recent steps: their losses beside those on held-out scenes, and how fast they went."""
    held_out_parts = trainer.validate(test)
    mean = {name: float(torch.stack([parts[name] for parts in recent]).mean()) for name in held_out_parts}
    figures = "  ".join(f"{name} {mean[name]:.3f} (held out {held_out_parts[name]:.3f})" for name in mean)
    return f"step {trainer.step}: {figures}  {pace.told(len(recent), trainer.config.fresh_per_step)}"
