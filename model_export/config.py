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
    its own (``MIXTURE``). Of all scenes ``frame_share`` are frames where there are some, of the others ``wall_share``
    nothing but a wall and ``room_share`` rooms, of the rest ``layered_share`` have up to ``max_layers`` surfaces, of
    which ``close_share`` are near each other in depth. Noise is alike in all colours in ``grey_share`` of the pictures
    that show no mosaic, and ``clean_share`` have none.
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
    frame_share: Share = 0.5
    wall_share: Share = 0.2
    room_share: Share = 0.5
    layered_share: Share = 0.7
    max_layers: Count = 6
    close_share: Share = 0.5
    grey_share: Share = 0.0
    clean_share: Share = 0.0


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
    """A training run: ``steps`` batches, drawn from a pool that ``fresh_per_step`` new scenes flow through.

    The last ``settled_share`` of the steps has the batch norms' statistics fixed, as the exported network has: all of
    them in a run that begins with weights, decoders' too. A ``taught`` run learns teachers' answers too, the side of
    focus among them where ``side_weight`` is 0 or the layout is what is learned, of two of four mirror images or of
    ``all_mirrors``; ``teacher_shares`` are each one's in the side, and in all else, alike if there are none.
    ``learning`` is what moves: all or the depth network alone, either without what tells the side by the layout, or
    that alone. Of the pictures ``turned_share`` do not stay upright, for ``hint_share`` a side is asked for;
    ``faded_share`` lose contrast and ``dimmed_share`` light before what learns, but no teacher, sees them. Of the steps
    ``large_share`` have a quarter as many, twice as large. With ``retaken`` the pool holds scenes, not pictures: each
    batch takes pictures of its own of them, where steps are computed (``darkroom.py``).
    """

    kind: Kind = "compact"
    seed: Annotated[int, Field(ge=0, le=MOST_SEED)] = 1
    steps: Count = 12_000
    batch: Count = 8
    learning_rate: Positive = 1e-3
    weight_decay: Weight = 1e-4
    warmup_steps: Count = 200
    decay_share: Share = 0.5
    clip_norm: Positive = 1.0
    b_weight: Weight = 1.0
    side_weight: Weight = 0.3
    taught: bool = False
    all_mirrors: bool = False
    teacher_shares: tuple[tuple[Weight, Weight], ...] = ()
    learning: Learning = "all"
    likeness_weight: Weight = 10.0
    pool: Count = 600
    fresh_per_step: Weight = 1.0
    retaken: bool = False
    turned_share: Share = 0.3
    hint_share: Share = 0.5
    large_share: Share = 0.0
    faded_share: Share = 0.0
    dimmed_share: Share = 0.0
    checkpoint_every: Count = 250
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
