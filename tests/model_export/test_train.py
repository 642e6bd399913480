"""Training: one seed is one run, stopped or not, and a run learns."""

import copy
import pickle
import re
import shutil
import signal
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from io import StringIO
from itertools import count
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from rich.console import Console

from model_export.batch_norms import folded, restored, spread_norms
from model_export.checkpoint import Checkpoint, starting_pair
from model_export.config import LARGE_SEED, MOST_SEED, Learning, SceneConfig, TrainConfig
from model_export.losses import UPRIGHT, UPSIDE_DOWN, Batch, likeness_loss, reduced, run_pair, told_by, total_loss
from model_export.networks import Widths, make_pair, with_fresh_decoders
from model_export.pool import HELD_OUT_SEED, Pools, SceneStream, collate
from model_export.scenes import Material, Sample, draw_sample
from model_export.textures import load_photographs
from model_export.train import CHECKPOINT, Trainer, config_of, emphasis, learning_rate, settling_step, train
from service.cores import available_cores

SHIPPED = Path(__file__).parents[2] / "service" / "models"
SCENES = SceneConfig(size_px=32, margin_px=8)
CONFIG = TrainConfig(
    steps=6, batch=2, pool=8, fresh_per_step=0.5, checkpoint_every=3, settle_batches=3, warmup_steps=2, scenes=SCENES
)


def test_anything_of_a_run_can_be_set() -> None:
    told = TrainConfig().adjusted(["decay_share=0.8", "scenes.k_cam_px=[1,20]"])
    assert told == replace(TrainConfig(), decay_share=0.8, scenes=replace(TrainConfig().scenes, k_cam_px=(1, 20)))


def test_no_seed_that_is_allowed_draws_scenes_that_are_scored() -> None:
    last = (MOST_SEED + 1) * 2**32 - 1  # of any run
    assert last < HELD_OUT_SEED + 2**32 < LARGE_SEED * 2**32


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("decay=0.8", "decay=0.8 sets nothing.*decay_share"),
        ("scenes.steps=1", "sets nothing.*frame_share"),
        ("batch", "sets nothing"),
        ("batch=many", "many is neither a number"),
        ("batch=0.5", "batch: .*integer"),
        ("scenes.k_cam_px=[1]", "scenes.k_cam_px.1: "),
        ("scenes.k_cam_px=[20,1]", "lower"),
        ("batch=0", "batch: "),
        ("seed=256", "seed: "),
        ("decay_share=-3", "decay_share: .*greater"),
        ("scenes.frame_share=2", "scenes.frame_share: .*less"),
        ("learning_rate=NaN", "learning_rate: .*finite"),
        ("warmup_steps=0", "warmup_steps: "),
        ("scenes.k_cam_px=[0,20]", "scenes.k_cam_px.0: "),
        ("scenes.size_px=50", "scenes.size_px: .*multiple of 16"),
    ],
)
def test_what_is_no_setting_is_refused_by_name(setting: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        TrainConfig().adjusted([setting])


@pytest.fixture(scope="module")
def textures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("textures")
    rng = np.random.default_rng(0)
    cv2.imwrite(str(folder / "noise.png"), rng.integers(0, 255, (90, 120, 3), np.uint8))
    return folder


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


# a second thread has so little to do here that both only wait for each other
train_here = partial(train, workers=0, threads=1)


def run(config: TrainConfig, textures: Path, folder: Path) -> tuple[Checkpoint, str]:
    said = StringIO()
    path = train_here(config, textures, folder, console=Console(file=said, width=200))
    return Checkpoint.load(path), said.getvalue()


@pytest.fixture(scope="module")
def first_run(textures: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The checkpoint of a whole run, and what it said."""
    folder = tmp_path_factory.mktemp("first")
    said = run(CONFIG, textures, folder)[1]
    return folder / CHECKPOINT, said


@pytest.fixture
def first(first_run: tuple[Path, str]) -> Checkpoint:
    return Checkpoint.load(first_run[0])


@pytest.fixture
def own_copy(first_run: tuple[Path, str], tmp_path: Path) -> Path:
    """That run's folder, to go on in."""
    return Path(shutil.copytree(first_run[0].parent, tmp_path / "run"))


def test_a_run_reports_and_ends_in_a_checkpoint(first_run: tuple[Path, str], first: Checkpoint) -> None:
    said = first_run[1]
    assert first.step == 6
    assert first.config == CONFIG
    assert "step 3: loss" in said
    assert re.search("held-out scenes .* 4/4", said)
    log = (first_run[0].parent / "log.txt").read_text()
    assert [line.split(":")[0] for line in log.splitlines()] == ["step 3", "step 6"]
    assert log.splitlines()[0] in said
    assert "held out" in said
    assert "scenes/s, waited" in said


def test_a_run_that_is_gone_on_with_keeps_its_settings_and_says_what_is_new(textures: Path, own_copy: Path) -> None:
    again = config_of(own_copy, ["steps=8", "learning_rate=5e-4"])
    assert again == replace(CONFIG, steps=8, learning_rate=5e-4)
    checkpoint, said = run(again, textures, own_copy)
    assert checkpoint.step == 8
    assert "going on from step 6, with steps 8 for 6, learning_rate 0.0005 for 0.001" in said
    with pytest.raises(ValueError, match="at step 8"):
        run(config_of(own_copy, ["steps=7"]), textures, own_copy)
    with pytest.raises(ValueError, match="trains a compact pair"):
        run(config_of(own_copy, ['kind="paper"']), textures, own_copy)
    with pytest.raises(ValueError, match="torch does not compute on cude"):
        train_here(again, textures, own_copy, device="cude")


def test_a_run_at_its_end_says_so_and_draws_nothing(
    textures: Path, own_copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr("model_export.pool.draw_sample")
    checkpoint, said = run(CONFIG, textures, own_copy)
    assert checkpoint.step == 6
    assert said.replace("\n", "").startswith(f"{own_copy} is at its end: go on with more --steps, or begin")


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_a_run_that_is_stopped_saves_what_it_did(
    textures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: signal.Signals
) -> None:
    advance = Trainer.advance

    def interrupted(self: Trainer, batch: Batch) -> dict[str, torch.Tensor]:
        if self.step == 1:
            signal.raise_signal(stop)
        return advance(self, batch)

    monkeypatch.setattr(Trainer, "advance", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(CONFIG, textures, tmp_path / "run")
    assert Checkpoint.load(tmp_path / "run" / CHECKPOINT).step == 2
    monkeypatch.undo()
    assert run(CONFIG, textures, tmp_path / "run")[0].step == CONFIG.steps


def test_a_run_that_is_made_shorter_still_settles_its_norms(
    textures: Path, first: Checkpoint, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settled: list[int] = []
    monkeypatch.setattr(Trainer, "settle", lambda self, _: settled.append(self.step))
    longer = replace(CONFIG, steps=20)
    assert settling_step(CONFIG) < 5 < settling_step(longer)
    replace(first, config=longer, step=5).save(tmp_path / CHECKPOINT)
    run(CONFIG, textures, tmp_path)
    assert settled == [5]
    replace(first, config=CONFIG, step=5).save(tmp_path / CHECKPOINT)
    run(CONFIG, textures, tmp_path)
    assert settled == [5]


def test_a_checkpoint_that_finds_no_room_is_said_and_leaves_the_one_before(first: Checkpoint, tmp_path: Path) -> None:
    first.save(tmp_path / CHECKPOINT)
    (tmp_path / CHECKPOINT).with_suffix(".part").symlink_to("/dev/full")
    with pytest.raises(OSError, match=r"checkpoint\.pt cannot be written: .*No space"):
        first.save(tmp_path / CHECKPOINT)
    assert [file.name for file in tmp_path.iterdir()] == [CHECKPOINT]
    assert Checkpoint.load(tmp_path / CHECKPOINT).step == first.step


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut off", pickle.dumps({"steps": 3}, 2)])
def test_what_is_no_checkpoint_is_said(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / CHECKPOINT
    path.write_bytes(content)
    with pytest.raises(ValueError, match="is no checkpoint of camind"):
        Checkpoint.load(path)


def test_the_mean_of_two_checkpoints_lies_between_them(first: Checkpoint, textures: Path, tmp_path: Path) -> None:
    second, _ = run(replace(CONFIG, seed=2), textures, tmp_path / "second")
    mean = first.averaged(second, 0.25)
    for name, own in first.modules.items():
        if own.is_floating_point():
            torch.testing.assert_close(mean.modules[name], 0.75 * own + 0.25 * second.modules[name])
    mean.pair()
    beyond, name = first.averaged(second, -0.25), "blur.head.weight"
    torch.testing.assert_close(beyond.modules[name], 1.25 * first.modules[name] - 0.25 * second.modules[name])
    far = first.averaged(second, -20).modules
    assert all(float(variance.min()) >= 0 for name, variance in far.items() if name.endswith("running_var"))
    of_blur = first.averaged(second, 1, "blur").modules
    moved = {name.split(".")[0] for name, own in first.modules.items() if not torch.equal(of_blur[name], own)}
    assert moved == {"blur"}
    with pytest.raises(ValueError, match="no mean"):
        first.averaged(replace(second, config=replace(CONFIG, kind="paper")))


def test_a_new_run_begins_with_the_weights_it_is_told(first_run: tuple[Path, str], first: Checkpoint) -> None:
    trainer = Trainer(replace(CONFIG, seed=2), "cpu")
    trainer.begin_with(starting_pair(first_run[0], "compact"))
    assert trainer.step == 0
    torch.testing.assert_close(trainer.modules.state_dict(), first.modules)
    for weights in (first_run[0], SHIPPED):
        with pytest.raises(ValueError, match="do not fit"):
            starting_pair(weights, "paper")


def test_a_new_run_goes_on_from_a_model_folder() -> None:
    batch = collate([draw_sample(seed, SCENES) for seed in range(2)], np.random.default_rng(0))
    start = starting_pair(SHIPPED, "compact")
    trainer = Trainer(CONFIG, "cpu", widths=Widths.of(start.modules().state_dict()))
    spread_norms(start, [partial(run_pair, start, batch)])
    trainer.begin_with(start)
    begun, shipped = folded(trainer.pair).modules(), folded(restored(SHIPPED)).modules()
    torch.testing.assert_close(begun.state_dict(), shipped.state_dict(), rtol=1e-3, atol=1e-4)


def test_decoders_that_begin_anew_leave_the_encoders_as_they_were() -> None:
    torch.manual_seed(1)
    pair = starting_pair(SHIPPED, "compact")
    before, after = pair.modules().state_dict(), with_fresh_decoders(pair).modules().state_dict()
    fresh = {name for name, own in before.items() if not torch.equal(own, after[name])}
    assert {name.split(".head.")[0].split(".decoder.")[0] for name in fresh} == {
        "blur",
        "blur.unet",
        "depth",
        "depth.layout",
        "depth.unet",
    }
    assert not any(".encoder." in name or ".surroundings." in name for name in fresh)


def test_norms_move_where_decoders_begin_anew(
    first_run: tuple[Path, str], first: Checkpoint, textures: Path, tmp_path: Path
) -> None:
    path = train_here(
        replace(CONFIG, seed=2),
        textures,
        tmp_path / "second",
        weights=first_run[0],
        fresh_decoders=True,
        console=Console(file=StringIO()),
    )
    second = Checkpoint.load(path)
    assert second.config.settled_share == CONFIG.settled_share
    running = {n: own for n, own in first.modules.items() if "running" in n and not n.startswith("depth.layout.")}
    assert not any(torch.equal(second.modules[name], own) for name, own in running.items())


def test_a_run_that_begins_with_weights_keeps_their_statistics(
    first_run: tuple[Path, str], first: Checkpoint, textures: Path, tmp_path: Path
) -> None:
    said = Console(file=StringIO())
    begun = replace(CONFIG, seed=2, steps=3)
    train_here(begun, textures, tmp_path / "second", weights=first_run[0], console=said)
    path = train_here(config_of(tmp_path / "second", ["steps=6"]), textures, tmp_path / "second", console=said)
    second = Checkpoint.load(path)
    assert second.step == 6
    for name, own in first.modules.items():
        if "running" in name:
            torch.testing.assert_close(second.modules[name], own, rtol=0, atol=0, msg=name)
    assert any(not torch.equal(second.modules[name], own) for name, own in first.modules.items())


@pytest.mark.parametrize("large_share", [0.0, 0.5])
def test_a_stopped_run_goes_on_as_if_it_had_not_been_stopped(
    textures: Path, tmp_path: Path, large_share: float
) -> None:
    config = replace(CONFIG, large_share=large_share)
    whole, _ = run(config, textures, tmp_path / "whole")
    (tmp_path / "stopped").mkdir()
    halfway = Trainer(config, "cpu")
    pool = Pools(config, Material(load_photographs(textures)), 0, 0)
    list(pool.fill())
    for step in range(3):
        halfway.advance(pool.batch(step))
        pool.refresh(step)
    halfway.checkpoint().save(tmp_path / "stopped" / CHECKPOINT)
    resumed, _ = run(config, textures, tmp_path / "stopped")
    for name, weight in whole.modules.items():
        torch.testing.assert_close(resumed.modules[name], weight, msg=name)


def test_some_steps_have_fewer_and_larger_pictures(textures: Path) -> None:
    pools = Pools(replace(CONFIG, batch=8, large_share=0.34), Material(load_photographs(textures)), 0, 0)
    assert len(list(pools.fill())) == pools.size
    shapes = [tuple(pools.batch(step).image.shape) for step in range(6)]
    assert shapes == 2 * [(8, 3, 32, 32), (8, 3, 32, 32), (2, 3, 64, 64)]


def test_a_run_is_the_same_whoever_draws_its_scenes(first: Checkpoint, textures: Path, tmp_path: Path) -> None:
    # of the cores that as many workers leave torch takes one all the same, as the first run did
    drawn = Checkpoint.load(train(CONFIG, textures, tmp_path / "run", workers=available_cores()))
    for name, weight in first.modules.items():
        torch.testing.assert_close(drawn.modules[name], weight, rtol=0, atol=0, msg=name)


@pytest.mark.parametrize(
    ("learning", "parts"),
    [
        ("all", {"blur.unet", "blur.head", "depth.unet", "depth.head"}),
        ("depth", {"depth.unet", "depth.head"}),
        ("layout", {"depth.layout"}),
    ],
)
def test_a_run_moves_what_is_to_learn_and_nothing_else(
    learning: Learning,
    parts: set[str],
    first_run: tuple[Path, str],
    first: Checkpoint,
    textures: Path,
    tmp_path: Path,
) -> None:
    config = replace(CONFIG, learning=learning)
    after = Checkpoint.load(train_here(config, textures, tmp_path / "next", weights=first_run[0]))
    moved = {name for name, own in first.modules.items() if not torch.equal(own, after.modules[name])}
    assert {".".join(name.split(".")[:2]) for name in moved} == parts


def test_the_papers_pair_has_no_layout_to_learn() -> None:
    with pytest.raises(ValueError, match="a paper pair has no layout"):
        Trainer(replace(CONFIG, kind="paper", learning="layout"), "cpu")


def test_statistics_follow_the_batches_until_they_are_settled() -> None:
    batch = collate([draw_sample(seed, SCENES) for seed in range(2)], np.random.default_rng(0))
    trainer = Trainer(CONFIG, "cpu")

    def moved() -> bool:
        before = {name: value.clone() for name, value in trainer.modules.state_dict().items() if "running" in name}
        trainer.advance(batch)
        after = trainer.modules.state_dict()
        return any(not torch.equal(after[name], value) for name, value in before.items())

    assert [moved() for _ in range(CONFIG.steps)] == [step < settling_step(CONFIG) for step in range(CONFIG.steps)]


def test_what_lies_on_the_side_that_nobody_asked_for_moves_no_depth() -> None:
    pair = make_pair("compact")
    samples = (draw_sample(seed, SCENES) for seed in count())
    both = next(s for s in samples if s.shot.side == 0 and s.excess.min() < 0 < s.excess.max())
    batch = collate([both], np.random.default_rng(0))
    config = replace(CONFIG, b_weight=0.0)

    def moved(side: int) -> bool:
        farther = torch.where(batch.excess < 0, 1.5 * batch.excess, batch.excess)
        told = replace(batch, side=torch.tensor([float(side)]))
        losses = [total_loss(pair, each, config)[0] for each in (told, replace(told, excess=farther))]
        return bool(losses[0] != losses[1])

    pair.modules().eval()
    assert [moved(side) for side in (-1, 0, 1)] == [False, True, True]


def test_a_few_steps_on_one_batch_lower_the_loss() -> None:
    config = replace(CONFIG, steps=1000)
    samples = [draw_sample(seed, SCENES) for seed in range(4)]
    batch = collate(samples, np.random.default_rng(0))
    trainer = Trainer(config, "cpu")
    losses = [trainer.advance(batch)["loss"] for _ in range(25)]
    assert np.mean(losses[-5:]) < np.mean(losses[:5])


def test_who_has_a_teacher_comes_to_answer_alike() -> None:
    batch = collate([draw_sample(seed, SCENES) for seed in range(4)], np.random.default_rng(0))
    torch.manual_seed(5)
    teacher = make_pair("compact")
    teacher.modules().eval()

    def apart(trainer: Trainer) -> float:
        with torch.inference_mode():
            own, wise = (run_pair(pair, batch)[0].blur_px for pair in (trainer.pair, teacher))
        return float((own / wise).log().abs().mean())

    alone, taught = (Trainer(replace(CONFIG, steps=1000, settled_share=1.0), "cpu") for _ in range(2))
    taught.learn_from(teacher)
    before = apart(taught)
    for _ in range(25):
        alone.advance(batch)
        taught.advance(batch)
    assert apart(taught) < min(0.7 * before, apart(alone))


def test_several_teachers_answer_as_their_mean() -> None:
    batch = collate([draw_sample(i, SCENES) for i in range(2)], np.random.default_rng(0))
    pairs = [make_pair("compact"), make_pair("compact")]
    for pair in pairs:
        pair.modules().eval()
    (one_blur, one), (other_blur, other) = (told_by([pair], batch) for pair in pairs)
    blur, depth = told_by(pairs, batch)
    torch.testing.assert_close(blur.blur_px, (one_blur.blur_px * other_blur.blur_px).sqrt())
    torch.testing.assert_close(depth.log_ratio_far, (one.log_ratio_far + other.log_ratio_far) / 2)
    assert not torch.equal(one.near_logit, other.near_logit)
    _, weighed = told_by(pairs, batch, [(1.0, 3.0), (0.0, 1.0)])
    torch.testing.assert_close(weighed.log_ratio_far, 0.75 * one.log_ratio_far + 0.25 * other.log_ratio_far)
    torch.testing.assert_close(weighed.near_logit, one.near_logit)


def test_shares_are_those_of_as_many_teachers() -> None:
    trainer = Trainer(TrainConfig(taught=True, teacher_shares=((1.0, 1.0), (1.0, 1.0))), "cpu")
    with pytest.raises(ValueError, match="2 teacher_shares are not those of 1 teachers"):
        trainer.learn_from(make_pair("compact"))


def test_a_teacher_answers_a_mirror_image_as_the_picture_where_it_sees_both() -> None:
    batch = collate([draw_sample(i, SCENES) for i in range(2)], np.random.default_rng(0))
    pair = make_pair("compact")
    pair.modules().eval()
    for mirrors, alike in ((UPRIGHT, True), (((),), False)):
        seen = replace(batch, mirrors=mirrors)
        (blur, depth), (mirrored_blur, mirrored) = (
            told_by([pair], one) for one in (seen, replace(seen, image=seen.image.flip(3)))
        )
        for own, other in (
            (blur.blur_px, mirrored_blur.blur_px),
            (depth.log_ratio_near, mirrored.log_ratio_near),
            (depth.log_scale, mirrored.log_scale),
        ):
            assert torch.allclose(own, other.flip(3), atol=1e-5) is alike


def test_every_batch_is_shown_to_teachers_upright_and_upside_down() -> None:
    sample = draw_sample(0, SCENES)
    drawn = {collate([sample], np.random.default_rng(seed)).mirrors for seed in range(40)}
    assert drawn == {(one, other) for one in UPRIGHT for other in UPSIDE_DOWN}
    everything = collate([sample], np.random.default_rng(0), TrainConfig(all_mirrors=True))
    assert everything.mirrors == UPRIGHT + UPSIDE_DOWN


def test_worn_pictures_have_less_contrast_or_light_in_grey_levels_still() -> None:
    samples = [draw_sample(seed, SCENES) for seed in range(12)]
    for config in (TrainConfig(faded_share=0.5), TrainConfig(dimmed_share=0.5)):
        batch = collate(samples, np.random.default_rng(0), config)
        (worn, mean), (whole, mean_before) = ((one, one.mean((2, 3))) for one in (batch.shown, batch.image))
        left = (worn.var((2, 3)).sum(1) / whole.var((2, 3)).sum(1)).sqrt()[:, None]
        is_worn = (worn != whole).flatten(1).any(1)
        assert 2 <= int(is_worn.sum()) <= 10
        assert float(left[is_worn].max()) < 1
        torch.testing.assert_close(worn.std((2, 3)), left * whole.std((2, 3)), atol=2e-3, rtol=0.02)
        light = left if config.dimmed_share else torch.ones_like(left)
        torch.testing.assert_close(mean, light * mean_before, atol=2e-3, rtol=0)
        levels = worn * 255
        torch.testing.assert_close(levels, levels.round(), atol=1e-3, rtol=0)


def test_a_share_of_the_pictures_is_learned_as_a_noise_filter_leaves_them() -> None:
    config = replace(CONFIG, filtered_share=0.5)
    drawn = [SceneStream(config, Material([]), 0, 40)[number] for number in range(40)]
    samples = [sample for sample in drawn if isinstance(sample, Sample)]
    unlike = [sample.shown is not None and (sample.shown != sample.image).mean() > 0.3 for sample in samples]
    assert 10 <= sum(unlike) <= 30
    assert all(sample.shown is None for sample, other in zip(samples, unlike, strict=True) if not other)
    batch = collate(samples, np.random.default_rng(0), config)
    assert (batch.shown != batch.image).flatten(1).any(1).tolist() == unlike
    unlike_by, down, across = ((batch.shown - batch.image.flip(axes)).abs().mean() for axes in ((), (2,), (3,)))
    assert max(unlike_by / down, unlike_by / across) < 0.1  # turned and mirrored alike


def test_teachers_see_whole_what_is_learned_of_worn_pictures() -> None:
    """How sure they are of the whole says nothing of how sure to be of less."""
    drawn = collate([draw_sample(seed, SCENES) for seed in range(2)], np.random.default_rng(0))
    whole = replace(drawn, mirrors=((),))
    mean = whole.image.mean((2, 3), keepdim=True)
    worn = replace(whole, shown=mean + 0.3 * (whole.image - mean))
    wise = make_pair("compact")
    with torch.no_grad():
        wise.modules().get_parameter("depth.head.bias")[
            4
        ] = -4.5  # so sure that plain inversion tells nothing of its own
    pair = copy.deepcopy(wise)

    def unlike(batch: Batch) -> float:
        return float(total_loss(pair, batch, CONFIG, [wise])[1]["likeness"])

    for one in (wise, pair):
        one.modules().eval()
    with torch.no_grad():
        of_whole, of_worn = unlike(whole), unlike(worn)
        assert of_whole == pytest.approx(0, abs=1e-6)
        assert of_worn > 1e-3
        pair.modules().get_parameter("depth.head.bias")[4] += 0.5  # how sure it is, no more
        assert unlike(whole) > 0.1
        assert unlike(worn) == pytest.approx(of_worn, rel=1e-3)


def test_the_side_is_learned_from_the_truth_alone_where_it_is_learned_from_that() -> None:
    """How often it is near is that of a teacher's own scenes."""
    batch = collate([draw_sample(seed, SCENES) for seed in range(2)], np.random.default_rng(0))
    wise, pair = make_pair("compact"), make_pair("compact")
    for one in (wise, pair):
        one.modules().eval()
    with torch.no_grad():
        before = likeness_loss(*run_pair(pair, batch), [wise], batch)
        bias = wise.modules().get_parameter("depth.head.bias")
        own = run_pair(pair, batch)
        sided = likeness_loss(*own, [wise], batch, of_side=True)
        bias[3] += 4
        assert torch.equal(likeness_loss(*own, [wise], batch), before)
        assert not torch.equal(likeness_loss(*own, [wise], batch, of_side=True), sided)
        bias[0] += 4
        assert not torch.equal(likeness_loss(*run_pair(pair, batch), [wise], batch), before)


def test_any_pixel_of_a_cell_is_its_truth_at_times_and_of_no_cell_another_s() -> None:
    sample = draw_sample(0, SCENES)
    names = torch.arange(2)[:, None] * 2 + torch.arange(2)
    excess = names.repeat(8, 8)[None, None].float()
    places = [collate([sample], np.random.default_rng(seed)).place for seed in range(40)]
    cells = [reduced(excess, 2, place) for place in places]
    assert all(cell.shape[-2:] == (8, 8) and cell.min() == cell.max() for cell in cells)
    assert {float(cell.max()) for cell in cells} == {0.0, 1.0, 2.0, 3.0}
    for place in places:  # the paper's networks answer every pixel
        torch.testing.assert_close(reduced(excess, 1, place), excess)


def test_the_learning_rate_warms_up_holds_and_falls_to_nothing() -> None:
    config = TrainConfig(steps=1000, warmup_steps=100)
    assert learning_rate(config, 0) < learning_rate(config, 50) < learning_rate(config, 100)
    assert learning_rate(config, 100) == learning_rate(config, 500) == config.learning_rate
    assert learning_rate(config, 999) < 0.01 * config.learning_rate


def test_what_stands_out_weighs_no_more_once_the_rate_falls() -> None:
    config = TrainConfig(steps=1000, decay_share=0.4)
    assert [emphasis(config, step) for step in (0, 300, 600, 999)] == pytest.approx([1, 0.5, 0, 0])
    assert learning_rate(config, 599) == config.learning_rate > learning_rate(config, 601)


def test_a_config_survives_json() -> None:
    config = replace(CONFIG, teacher_shares=((0.5, 0.1), (0.5, 0.9)))
    assert TrainConfig.from_dict(config.as_dict()) == config


def test_a_folder_without_pictures_is_said(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no JPEG or PNG"):
        train_here(CONFIG, tmp_path, tmp_path / "run")


def test_a_run_that_began_with_a_teacher_goes_on_with_one(textures: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    path = train_here(replace(CONFIG, steps=3), textures, folder, teachers=[SHIPPED])
    assert Checkpoint.load(path).config.taught
    with pytest.raises(ValueError, match="begun with a --teacher: go on with one"):
        train_here(CONFIG, textures, folder)
    assert Checkpoint.load(train_here(CONFIG, textures, folder, teachers=[SHIPPED])).step == CONFIG.steps


def test_a_checkpoint_of_another_version_says_so(own_copy: Path) -> None:
    path = own_copy / CHECKPOINT
    content = torch.load(path, weights_only=True)
    content["config"]["forgotten"] = 1
    for config in (content["config"], {"width": 3}):  # the other is somebody else's
        torch.save(content | {"config": config}, path)
        with pytest.raises(ValueError, match="another version"):
            Checkpoint.load(path)
