"""Both pairs of networks, behind one interface."""

import copy
import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import nn
from torch.nn import functional

from model_export.band_energy import LUMINANCE, BandEnergy
from model_export.batch_norms import folded
from model_export.config import Kind, TrainConfig
from model_export.losses import STANDING_OUT, Batch, correct, laplace, run_pair, standing_out, total_loss
from model_export.networks import (
    BlurEstimate,
    Conditioning,
    DepthEstimate,
    Layout,
    Pair,
    Surroundings,
    make_pair,
    parameter_count,
)
from model_export.render import blur

KINDS: list[Kind] = ["compact", "paper"]


def batch(size: int = 64, count: int = 2) -> Batch:
    torch.manual_seed(0)
    numbers = [torch.full((count,), value) for value in (3.81, 0.5, 0.5, 2.0, 500.0, 0.0)]
    images, excess = torch.rand(count, 3, size, size), torch.rand(count, 1, size, size) - 0.3
    return Batch(images, images, excess, *numbers)


@pytest.mark.parametrize("kind", KINDS)
def test_both_pairs_answer_alike(kind: Kind) -> None:
    pair = make_pair(kind)
    seen, told = run_pair(pair, batch())
    cells = (2, 1, 64 // pair.stride, 64 // pair.stride)
    maps = (seen.blur_px, seen.log_error, told.log_ratio_near, told.log_ratio_far, told.near_logit, told.log_scale)
    for values in maps:
        assert values.shape == cells
        assert torch.isfinite(values).all()
    assert (seen.blur_px > 0).all()


@pytest.mark.parametrize(
    ("kind", "network", "channels_and_sizes"),
    [
        ("compact", "blur", ((3, 64), (12, 32))),
        ("compact", "depth", ((16, 32), (8, 32))),
        ("paper", "blur", ((3, 64),)),
    ],
)
def test_folding_changes_no_answer_even_at_the_border(
    kind: Kind, network: str, channels_and_sizes: tuple[tuple[int, int], ...]
) -> None:
    pair = make_pair(kind)
    for name, values in pair.modules().state_dict().items():
        if values.is_floating_point():  # batch norms' too, which start as the identity
            spread = torch.rand_like(values) * 0.4
            values.copy_(0.8 + spread if name.endswith("running_var") else values + spread - 0.2)
    pair.modules().eval().double()
    given = [torch.rand(1, channels, size, size).double() for channels, size in channels_and_sizes]
    with torch.inference_mode():
        expected, found = (one.modules().get_submodule(f"{network}.unet")(*given) for one in (pair, folded(pair)))
    for ours, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, theirs)


def test_folding_leaves_no_norm_and_the_pair_in_training_alone() -> None:
    pair = make_pair("compact")
    before = copy.deepcopy(pair.modules().state_dict())
    assert not [module for module in folded(pair).modules().modules() if isinstance(module, torch.nn.BatchNorm2d)]
    torch.testing.assert_close(pair.modules().state_dict(), before)
    assert pair.blur.training


def test_the_papers_pair_has_its_size() -> None:
    assert parameter_count(make_pair("paper")) == pytest.approx(3.7e6, rel=0.02)


def test_ours_is_compact() -> None:
    assert parameter_count(make_pair("compact")) < 0.8e6


def test_a_far_look_starts_as_no_look() -> None:
    x = torch.rand(1, 8, 16, 16)
    torch.testing.assert_close(Surroundings(8, 4)(x), x)


def test_ours_keeps_each_hypothesis_on_its_side_of_focus() -> None:
    _, told = run_pair(make_pair("compact"), batch())
    assert (told.log_ratio_near <= 0).all()
    assert (told.log_ratio_far >= 0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_every_weight_learns_from_the_joint_loss(kind: Kind) -> None:
    pair = make_pair(kind)
    loss, parts = total_loss(pair, batch(), TrainConfig(kind=kind))
    torch.autograd.backward(loss)
    assert set(parts) == {"loss", "blur", "depth", "side"}
    for name, weight in pair.modules().named_parameters():
        assert weight.grad is not None, name
        assert torch.isfinite(weight.grad).all(), name


class Knowing(nn.Module):
    """A network with the same answer to everything."""

    def __init__(self, answer: BlurEstimate | DepthEstimate) -> None:
        super().__init__()
        self.answer = answer

    def forward(self, *_: Any) -> BlurEstimate | DepthEstimate:
        return self.answer


def test_who_answers_the_truth_on_its_side_is_off_by_nothing() -> None:
    """Whatever is told of gamma, and whatever is answered of the other side of focus."""
    seen = replace(batch(), told_gamma_px=torch.full((2,), 1.5))
    log_ratio, none = -torch.log1p(seen.excess), torch.zeros_like(seen.excess)
    near, far = (torch.where(side, log_ratio, log_ratio + 1) for side in (seen.excess > 0, seen.excess <= 0))
    blur_px = torch.hypot(3.81 * seen.excess, torch.tensor(0.5))
    depth = Knowing(DepthEstimate(near, far, 50 * seen.excess.sign(), none))
    _, parts = total_loss(Pair("compact", Knowing(BlurEstimate(blur_px, none, ())), depth, 1), seen, TrainConfig())
    assert [float(parts[name]) for name in ("blur", "depth", "side")] == pytest.approx([0, 0, 0], abs=1e-5)


def test_the_scale_that_is_likeliest_is_the_mean_error() -> None:
    error = torch.tensor([0.05, 0.1, 0.3, 0.15])
    log_scale = torch.full((4,), math.log(0.15), requires_grad=True)
    (slope,) = torch.autograd.grad(laplace(error, log_scale).sum(), log_scale)
    assert float(slope.sum()) == pytest.approx(0, abs=1e-6)


def test_networks_are_told_gamma_as_it_is_guessed() -> None:
    pair, seen = make_pair("compact"), batch()
    pair.modules().eval()
    softer = torch.full((2,), 0.9)
    guessed, other = replace(seen, told_gamma_px=softer), replace(seen, gamma_px=softer)
    told = [run_pair(pair, one)[1].log_ratio_near for one in (seen, guessed, other)]
    assert not torch.equal(told[0], told[1])
    assert torch.equal(told[0], told[2])


def test_what_is_unlike_its_surroundings_weighs_more() -> None:
    level = torch.zeros(1, 1, 96, 96)
    torch.testing.assert_close(standing_out(level), torch.ones_like(level))
    post = level.clone()
    post[..., 46:50] = 1.0
    weight = standing_out(post)
    assert float(weight.mean()) == pytest.approx(1, abs=1e-5)
    assert float(weight[..., 47].mean() / weight[..., 0].mean()) == pytest.approx(1 + STANDING_OUT)
    assert float(weight[..., 44].mean()) < 0.5 * float(weight[..., 47].mean())
    torch.testing.assert_close(standing_out(post, 0.0), torch.ones_like(post))


@pytest.mark.parametrize("name", ["b_weight", "side_weight"])
def test_a_weight_scales_its_part_of_the_loss_alone(name: str) -> None:
    pair = make_pair("compact")
    pair.modules().eval()
    configs: list[dict[str, Any]] = [{name: weight} for weight in (0.0, 1.0, 2.0)]
    with torch.no_grad():
        zero, one, two = (float(total_loss(pair, batch(), TrainConfig(**config))[0]) for config in configs)
    assert two - one == pytest.approx(one - zero, rel=1e-4)
    assert one != zero


def test_band_energies_fall_with_blur_finest_first() -> None:
    torch.manual_seed(1)
    sharp = torch.rand(1, 3, 128, 128)
    front = BandEnergy()
    lost = (front(sharp) - front(blur(sharp, 1.5))).mean((0, 2, 3))
    assert (lost[:8] > 0).all()
    assert lost[0] > lost[4] > lost[9]


def test_the_finest_bands_in_cells_are_those_of_pixels() -> None:
    picture = torch.rand(1, 3, 64, 96).double()
    grey = (picture * torch.tensor(LUMINANCE)[None, :, None, None].double()).sum(1, keepdim=True)
    once, twice = (gaussian_blurred(grey, BandEnergy.FIRST_SIGMA * 2 ** (i / BandEnergy.BANDS)) for i in (0, 1))
    energy = gaussian_blurred((once - twice) ** 2, BandEnergy.SMOOTH_SIGMA)[..., ::2, ::2]
    expected = torch.log(energy + BandEnergy.FLOOR) * 0.25 + 2
    found = BandEnergy().double()(picture)[:, :1]
    inner = (..., slice(8, -8), slice(8, -8))  # elsewhere the edge goes on, for the smoothing as for the picture
    torch.testing.assert_close(found[inner], expected[inner], rtol=1e-4, atol=1e-5)


def gaussian_blurred(maps: torch.Tensor, sigma: float) -> torch.Tensor:
    taps = torch.exp(-0.5 * (torch.arange(-4, 5) / sigma) ** 2).double()
    kernel = torch.outer(taps, taps)[None, None] / taps.sum() ** 2
    return functional.conv2d(functional.pad(maps, (4,) * 4, mode="replicate"), kernel)


def test_correction_takes_the_camera_out() -> None:
    """The same scene by two cameras: other blur, the same relative defocus."""
    pair = make_pair("compact")
    seen = pair.blur(batch().image)
    wider = type(seen)(seen.blur_px * 3, seen.log_error, seen.features)
    ones = torch.ones(2)
    one, _ = correct(seen, 0.1 * ones, 2 * ones, 0.0)
    other, _ = correct(wider, 0.3 * ones, 6 * ones, 0.0)
    torch.testing.assert_close(one, other)


@pytest.mark.parametrize(
    ("x", "spread", "gate", "told"),
    [(0.25, 0.005, 0.5, True), (0.25, 0.25, 0.5, False), (3.0, 0.05, 0.0, False)],
    ids=["sure", "unsure", "sure and far off"],
)
def test_plain_inversion_tells_where_it_is_far_surer_and_hardly_apart(
    x: float, spread: float, gate: float, *, told: bool
) -> None:
    """The network takes so much of it on its own, and the rest from a guess at z / s1 = 0.5 and 2."""
    depth = make_pair("compact").depth
    head = depth.get_submodule("head")
    log_scale = math.log(0.1)
    with torch.no_grad():
        head.get_parameter("weight").zero_()
        head.get_parameter("bias").copy_(torch.tensor([0.0, 0.0, torch.logit(torch.tensor(gate)), 0.0, log_scale]))
    cell = torch.ones(1, 1, 16, 16)
    one = torch.ones(1)
    with torch.no_grad():
        answer = depth(x * cell, spread * cell, Conditioning(2 * one, 500 * one, 0 * one), (torch.rand(1, 16, 16, 16),))
    plain, guess = -math.log1p(x), -math.log(2)
    wanted = plain if told else gate * plain + (1 - gate) * guess
    assert answer.log_ratio_near.mean().item() == pytest.approx(wanted, abs=0.005)


def test_the_layout_says_nothing_at_first_and_looks_far_once_it_learned() -> None:
    """A cell of its map, 16 pixels of the picture, is told by those up to 16 away."""
    torch.manual_seed(0)
    layout = Layout(coarsest=48).eval()
    coarse = torch.rand(1, 48, 40, 40)
    assert layout(coarse).shape == (1, 1, 40, 40)
    assert (layout(coarse) == 0).all()
    for part in layout.modules():
        if isinstance(part, Surroundings):
            torch.nn.init.ones_(part.change.norm.get_parameter("weight"))
    torch.nn.init.normal_(layout.head.weight)
    other = coarse.clone()
    other[..., 20, 36] += 1.0
    moved = (layout(other) - layout(coarse)).abs().amax((0, 1)) > 0
    assert moved[20, 20]
    assert not moved[:, :20].any()
