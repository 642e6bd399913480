"""What training minimises: L_depth + b_weight * L_blur (eq. 8), each a likelihood, so that errors are stated."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace

import torch
from torch import Tensor
from torch.nn import functional

from model_export.config import TrainConfig
from model_export.networks import BlurEstimate, Conditioning, DepthEstimate, Pair
from service.inference.artifact import BLUR_ERROR_RANGE
from service.optics import thin_lens

DEFOCUS_FLOOR_PX = 0.05
BETA = 0.5
SIDE_VISIBLE_PX = 0.3
STANDING_OUT = 3.0
AROUND = 33  # cells of the networks' resolution, across
FULLY_OUT = 0.5

Mirror = tuple[int, ...]  # axes of [n,c,h,w]; none: as it is
UPRIGHT: tuple[Mirror, Mirror] = ((), (3,))
UPSIDE_DOWN: tuple[Mirror, Mirror] = ((2,), (2, 3))


@dataclass(frozen=True, slots=True)
class Batch:
    """Images [n,3,h,w] in 0..1, q - 1 = s1/z - 1 as [n,1,h,w], and per image [n] its camera and side (-1/0/+1).

    ``told_gamma_px`` is what the correction is given: a guess where gamma is not known. ``side`` is the one
    asked for, 0 for both: the other may be in the picture. ``place`` in 0..1 is which pixel of a network's cell its
    truth is, down and across: any at times, for always the first would move all answers by half a pixel.
    ``mirrors`` are the axes along which teachers see it mirrored, one of ``UPRIGHT`` among them: what they answer on
    average errs less. ``shown`` are the images that what learns sees: worn ones, some of them.
    """

    image: Tensor
    shown: Tensor
    excess: Tensor
    k_cam_px: Tensor
    gamma_px: Tensor
    told_gamma_px: Tensor
    focus_distance_m: Tensor
    focal_length_px: Tensor
    side: Tensor
    place: tuple[float, float] = field(default=(0.0, 0.0), kw_only=True)
    mirrors: tuple[Mirror, ...] = field(default=((),), kw_only=True)

    def tensors(self) -> list[Tensor]:
        """All that a device holds of it."""
        values = (getattr(self, each.name) for each in fields(self))
        return [value for value in values if isinstance(value, Tensor)]

    def changed(self, change: Callable[[Tensor], Tensor]) -> "Batch":
        """With every tensor changed."""
        return Batch(*map(change, self.tensors()), place=self.place, mirrors=self.mirrors)

    def conditioning(self) -> Conditioning:
        return Conditioning(self.focus_distance_m, self.focal_length_px, self.side)


def laplace(error: Tensor, log_scale: Tensor) -> Tensor:
    """Negative log-likelihood of an absolute error under a Laplace law with the stated log scale, weighted.

    The weight is the stated scale to the power ``BETA`` (Seitzer et al., ICLR 2022), which moves no optimum: without
    it the pull on what is hard to read, strong blur, is the weaker the worse it is read.
    """
    weight = torch.exp(BETA * log_scale.detach())
    return weight * (error * torch.exp(-log_scale) + log_scale)


def correct(blur: BlurEstimate, gamma_px: Tensor, k_cam_px: Tensor, floor_px: float) -> tuple[Tensor, Tensor]:
    """Relative defocus and its spread from the blur network's answer: what happens between the two graphs."""
    gamma, k_cam = gamma_px[:, None, None, None], k_cam_px[:, None, None, None]
    error = torch.exp(blur.log_error).clamp(*BLUR_ERROR_RANGE)
    x = thin_lens.relative_defocus_from_blur(blur.blur_px, gamma, k_cam, floor_px)
    spread = thin_lens.relative_defocus_spread(blur.blur_px, error, gamma, k_cam, floor_px)
    return x, spread


def run_pair(pair: Pair, batch: Batch) -> tuple[BlurEstimate, DepthEstimate]:
    """Both networks with the camera correction between, in training's differentiable form."""
    blur: BlurEstimate = pair.blur(batch.image)
    x, spread = correct(blur, batch.told_gamma_px, batch.k_cam_px, DEFOCUS_FLOOR_PX)
    depth: DepthEstimate = pair.depth(x, spread.detach(), batch.conditioning(), blur.features)
    return blur, depth


def reduced(excess: Tensor, stride: int, place: tuple[float, float]) -> Tensor:
    """Truth at the networks' resolution: one pixel of each cell, since a mean across a depth edge is no depth."""
    down, across = (int(part * stride) for part in place)
    return excess[:, :, down::stride, across::stride]


def standing_out(log_truth: Tensor, emphasis: float | Tensor = 1.0) -> Tensor:
    """Weights [n,1,h,w] of mean 1: up to four times as much where the truth is unlike the mean of what is around.

    Most pixels are like their surroundings, so that to answer those everywhere costs little: a chair becomes the wall.
    ``emphasis`` is from 0 (all weigh alike) to 1. What weighs more is answered more often than it is true, where
    nothing tells: smooth ends of a table become things of their own. So it is for the beginning.
    """
    around = functional.pad(log_truth, (AROUND // 2,) * 4, mode="replicate")
    for window in ((AROUND, 1), (1, AROUND)):  # down, then across: a seventeenth of the work
        around = functional.avg_pool2d(around, window, stride=1)
    unlike = (log_truth - around).abs()
    weight = 1 + emphasis * STANDING_OUT * (unlike / FULLY_OUT).clamp(max=1)
    return weight / weight.mean()


def told_by(
    teachers: Sequence[Pair], batch: Batch, shares: Sequence[tuple[float, float]] = ()
) -> tuple[BlurEstimate, DepthEstimate]:
    """What pairs answer on average, in logarithms and logits: of different descent, they err differently.

    So does one pair of a picture and of its mirror images: the mean over the batch's ``mirrors`` is taken too. The side
    is asked of upright ones alone: what is lower is nearer. ``shares`` are each teacher's in the side, and in all else.
    """
    weighed = zip(teachers, shares or [(1.0, 1.0)] * len(teachers), strict=True)
    asked = [(teacher, mirror, share) for teacher, share in weighed for mirror in batch.mirrors]
    of_side = [share[0] * (mirror in UPRIGHT) for _, mirror, share in asked]
    of_answer = [share[1] for *_, share in asked]

    def mean(maps: Iterable[Tensor], weights: Sequence[float]) -> Tensor:
        parts = zip(maps, asked, weights, strict=True)
        return torch.stack([weight * one.flip(mirror) for one, (_, mirror, _), weight in parts]).sum(0) / sum(weights)

    with torch.no_grad():
        views = {mirror: replace(batch, image=batch.image.flip(mirror)) for mirror in batch.mirrors}
        answers = [run_pair(teacher, views[mirror]) for teacher, mirror, _ in asked]
        blurs, depths = zip(*answers, strict=True)
        blur_px = torch.exp(mean((torch.log(blur.blur_px) for blur in blurs), of_answer))
        depth = DepthEstimate(
            mean((depth.log_ratio_near for depth in depths), of_answer),
            mean((depth.log_ratio_far for depth in depths), of_answer),
            mean((depth.near_logit for depth in depths), of_side),
            mean((depth.log_scale for depth in depths), of_answer),
        )
        return BlurEstimate(blur_px, mean((blur.log_error for blur in blurs), of_answer), ()), depth


def likeness_loss(
    blur: BlurEstimate,
    depth: DepthEstimate,
    teachers: Sequence[Pair],
    batch: Batch,
    shares: Sequence[tuple[float, float]] = (),
    *,
    of_side: bool = False,
) -> Tensor:
    """How far the answers are from the teachers', most where these are sure: float32 scalar.

    But for the side, if not asked for: how often it is near is that of the scenes a teacher saw. Teachers see no worn
    picture: how sure they are says nothing of it.
    """
    wise_blur, wise_depth = told_by(teachers, batch, shares)
    sure_blur = torch.exp(-BETA * wise_blur.log_error)
    sure_depth = torch.exp(-BETA * wise_depth.log_scale) / 2
    of_blur = sure_blur * (torch.log(blur.blur_px) - torch.log(wise_blur.blur_px)).abs()
    of_near = sure_depth * (depth.log_ratio_near - wise_depth.log_ratio_near).abs()
    of_far = sure_depth * (depth.log_ratio_far - wise_depth.log_ratio_far).abs()
    of_errors = (blur.log_error - wise_blur.log_error).abs() + (depth.log_scale - wise_depth.log_scale).abs()
    of_errors = of_errors * (batch.shown == batch.image).flatten(1).all(1)[:, None, None, None]
    side = (torch.sigmoid(depth.near_logit) - torch.sigmoid(wise_depth.near_logit)).abs() if of_side else 0.0
    return (of_blur + of_near + of_far + of_errors / 2 + side).mean()


def total_loss(
    pair: Pair, batch: Batch, config: TrainConfig, teachers: Sequence[Pair] = (), emphasis: float | Tensor = 0.0
) -> tuple[Tensor, dict[str, Tensor]]:
    """The loss of a batch and its parts by name, all float32 scalars; the teachers' part is ``likeness_weight``.

    ``emphasis`` is that of what stands out.
    """
    blur, depth = run_pair(pair, replace(batch, image=batch.shown))
    excess = reduced(batch.excess, pair.stride, batch.place).float()
    defocus_px = excess.abs() * batch.k_cam_px[:, None, None, None]
    true_blur = thin_lens.blur_from_defocus(defocus_px, batch.gamma_px[:, None, None, None])
    blur_error = (torch.log(blur.blur_px) - torch.log(true_blur)).abs()
    is_near = (excess > 0).float()
    log_ratio = torch.where(excess > 0, depth.log_ratio_near, depth.log_ratio_far)
    depth_error = (log_ratio + torch.log1p(excess)).abs()
    asked = (batch.side[:, None, None, None] * excess <= 0).float()
    side_seen = asked * (defocus_px > SIDE_VISIBLE_PX)
    side = functional.binary_cross_entropy_with_logits(depth.near_logit, is_near, weight=side_seen)
    of_blur, of_depth = (standing_out(truth, emphasis) for truth in (torch.log(true_blur), torch.log1p(asked * excess)))
    blur_loss = (of_blur * laplace(blur_error, blur.log_error)).mean()
    depth_loss = (asked * of_depth * laplace(depth_error, depth.log_scale)).mean()
    loss = depth_loss + config.b_weight * blur_loss + config.side_weight * side
    parts = {"loss": loss, "blur": blur_error.mean(), "depth": (asked * depth_error).sum() / asked.sum(), "side": side}
    if teachers:
        of_side = config.learning == "layout" or not config.side_weight
        parts["likeness"] = likeness_loss(blur, depth, teachers, batch, config.teacher_shares, of_side=of_side)
        parts["loss"] = loss + config.likeness_weight * parts["likeness"]
    return parts["loss"], {name: part.detach() for name, part in parts.items()}
