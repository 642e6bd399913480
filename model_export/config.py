"""One config for a training run; it travels inside every checkpoint and the manifest."""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, ValidationError

LARGER = 2  # times as wide and as high
LARGE_SEED = 2**16  # larger pictures' seed is so much above
MOST_SEED = 255  # the scenes that models are scored on have those above

Share = Annotated[float, Field(ge=0, le=1)]
Weight = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Span = tuple[Positive, Positive]
Quality = Annotated[int, Field(ge=1, le=100)]
Count = Annotated[int, Field(ge=1)]

Kind = Literal["compact", "paper"]
Learning = Literal["all", "depth", "layout"]
Part = Literal["blur", "depth", "depth.layout"]


def first_error(exc: ValidationError) -> str:
    """Where the first of the errors is, and what is wrong there."""
    wrong = exc.errors(include_url=False)[0]
    place = ".".join(map(str, wrong["loc"]))
    return f"{place}: {wrong['msg']}" if place else wrong["msg"]


@dataclass(frozen=True, slots=True)
class SceneConfig:
    """What the procedural scenes span, in ranges (low, high) that the manifest states, and what they are mixed of.

    As it is here they are what models are scored on, which stays, so that scores compare; training has a mixture of
    its own (``MIXTURE``).
    """

    size_px: Annotated[int, Field(ge=16, multiple_of=16)] = 192
    margin_px: Annotated[int, Field(ge=0)] = 32
    k_cam_px: Span = (0.5, 30.0)
    gamma_px: Span = (0.3, 1.6)
    focus_distance_m: Span = (0.2, 5.0)
    focal_length_px: Span = (150.0, 2500.0)
    defocus_px: Span = (0.4, 20.0)
    depth_ratio: Span = (0.15, 8.0)
    jpeg_quality: tuple[Quality, Quality] = (60, 98)
    frame_share: Share = 0.5  # frames, where there are some; the others are drawn:
    wall_share: Share = 0.2  # of them nothing but a wall
    room_share: Share = 0.5  # of them rooms
    layered_share: Share = 0.7  # of the rest up to ``max_layers`` surfaces, and not one alone
    max_layers: Count = 6
    close_share: Share = 0.5  # of these near each other in depth
    grey_share: Share = 0.0  # noise alike in all colours, of the pictures that show no mosaic
    clean_share: Share = 0.0  # no noise, of all pictures


# depth differs more within a picture than in those that are scored: of such a mixture networks learn outlines
MIXTURE = SceneConfig(
    frame_share=0.4,
    room_share=0.35,
    layered_share=0.85,
    max_layers=9,
    close_share=0.25,
    grey_share=0.35,
    clean_share=0.25,
)


@dataclass(frozen=True, slots=True)
class TrainConfig:
    """A training run: ``steps`` batches, drawn from a pool that ``fresh_per_step`` new scenes flow through."""

    kind: Kind = "compact"
    seed: Annotated[int, Field(ge=0, le=MOST_SEED)] = 1
    steps: Count = 12_000
    batch: Count = 8
    learning_rate: Positive = 1e-3
    weight_decay: Weight = 1e-4
    warmup_steps: Count = 200
    decay_share: Share = 0.5  # of the steps, the last ones: the rate falls to nothing
    clip_norm: Positive = 1.0
    b_weight: Weight = 1.0  # of L_blur (eq. 8)
    side_weight: Weight = 0.3
    # teachers' answers are learned too, the side among them where ``side_weight`` is 0 or the layout is what is learned
    taught: bool = False
    all_mirrors: bool = False  # teachers answer all four mirror images of a picture, or two
    teacher_shares: tuple[tuple[Weight, Weight], ...] = ()  # each one's in the side, and in all else; none: alike
    # all or the depth network alone move, either without what tells the side by the layout, or that alone
    learning: Learning = "all"
    likeness_weight: Weight = 10.0
    pool: Count = 600
    fresh_per_step: Weight = 1.0
    # the pool holds scenes, not pictures: each batch takes its own of them, where steps are computed (``darkroom.py``)
    retaken: bool = False
    turned_share: Share = 0.3  # of the pictures: not upright
    hint_share: Share = 0.5  # of the pictures: a side is asked for
    large_share: Share = 0.0  # of the steps: a quarter as many pictures, twice as large
    faded_share: Share = 0.0  # of the pictures: less contrast, for what learns and for no teacher
    dimmed_share: Share = 0.0  # of the pictures: less light, likewise
    filtered_share: Share = 0.0  # of the pictures: a noise filter's traces, likewise
    checkpoint_every: Count = 250
    # of the steps, the last ones: batch norms' statistics are fixed, as in the exported network; all of them in a run
    # that begins with weights, decoders' too
    settled_share: Share = 0.35
    settle_batches: Count = 60
    scenes: SceneConfig = MIXTURE

    def enlarged(self) -> "TrainConfig":
        """What the steps with larger pictures draw from: scenes of their own, a quarter as many."""
        return replace(
            self,
            seed=self.seed + LARGE_SEED,
            batch=max(1, self.batch // LARGER**2),
            pool=max(1, self.pool // LARGER**2),
            fresh_per_step=self.fresh_per_step / LARGER**2,
            scenes=replace(self.scenes, size_px=LARGER * self.scenes.size_px),
        )

    def as_dict(self) -> dict[str, Any]:
        """The config as JSON has it."""
        values: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return values

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> "TrainConfig":
        """Inverse of ``as_dict``."""
        scenes: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in values["scenes"].items()
        }
        shares = tuple(map(tuple, values.get("teacher_shares", ())))
        return cls(**{**values, "scenes": SceneConfig(**scenes), "teacher_shares": shares})

    def adjusted(self, settings: Iterable[str]) -> "TrainConfig":
        """This one with values given as ``name=JSON``, those of the scenes as ``scenes.name=JSON``.

        Raises ``ValueError`` for a name that it does not have, or a value of another kind or out of bounds.
        """
        values = self.as_dict()
        for setting in settings:
            name, _, value = setting.partition("=")
            within = values["scenes"] if name.startswith("scenes.") else values
            own = name.removeprefix("scenes.")
            if own not in within or not value:
                raise ValueError(f"{setting} sets nothing: it is name=value, with a name of {', '.join(within)}")
            try:
                within[own] = json.loads(value)
            except json.JSONDecodeError as exc:
                raise ValueError(f"{setting}: {value} is neither a number nor other JSON") from exc
        try:
            told = TypeAdapter(TrainConfig).validate_python(values)
        except ValidationError as exc:
            raise ValueError(first_error(exc)) from exc
        for name, span in asdict(told.scenes).items():
            if isinstance(span, tuple) and span[0] > span[1]:
                raise ValueError(f"scenes.{name}: the first of {list(span)} is to be the lower one")
        return told

    def unlike(self, other: "TrainConfig") -> list[str]:
        """What is set otherwise than in another, as ``name value for value``."""
        ours, theirs = ({**own, **own.pop("scenes")} for own in (self.as_dict(), other.as_dict()))
        return [f"{name} {value} for {theirs[name]}" for name, value in ours.items() if value != theirs[name]]


UNCHANGED = TrainConfig()
