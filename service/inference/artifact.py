"""The model folder: the graphs, a model card and the manifest that vouches for them.

The manifest is the contract between training, which writes it last, and the service, which believes no
file that it does not vouch for. Nothing here knows how a graph is run.
"""

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, Self

from pydantic import (
    AfterValidator,
    AwareDatetime,
    BaseModel,
    ConfigDict,
    Field,
    JsonValue,
    ValidationError,
    model_validator,
)

SCHEMA_VERSION: Literal[1] = 1
MANIFEST_FILE = "manifest.json"
FEATURES_PREFIX = "features"
# in the order that graphs are written with
BLUR_INPUTS = ("image",)
BLUR_OUTPUTS = ("blur_px", "blur_log_error")
DEPTH_INPUTS = ("relative_defocus", "relative_defocus_spread", "focus_distance_m", "focal_length_px", "side")
DEPTH_OUTPUTS = ("log_ratio_near", "log_ratio_far", "p_near", "log_scale")
LAYOUT_MAP, LAYOUT_ODDS = "layout_map", "layout_odds"
BLUR_ERROR_RANGE = (0.01, 2.0)  # that relative errors of blur are held within before the depth graph sees them

FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$")]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class ModelFolderError(ValueError):
    """A model folder that must not be served; the message names the file and what is wrong with it."""


def _require_ordered(interval: "Interval") -> "Interval":
    if not interval.low <= interval.high:
        raise ValueError(f"a range needs low <= high, not {list(interval)}")
    return interval


def _require_names(what: str, names: tuple[str, ...], *needed: str) -> None:
    if missing := set(needed) - set(names):
        raise ValueError(f"the {what} lack {sorted(missing)}")


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class TensorSpec(_Part):
    """An input or output by name; in ``shape`` a number is fixed, a name (``"h/2"``) is not."""

    name: Annotated[str, Field(min_length=1)]
    shape: tuple[int | str, ...]


class CardFile(_Part):
    """The model card."""

    file: FileName
    sha256: Sha256


class GraphFile(_Part):
    """One ONNX graph, and what goes in and comes out of it."""

    file: FileName
    sha256: Sha256
    inputs: tuple[TensorSpec, ...]
    outputs: tuple[TensorSpec, ...]

    @property
    def input_names(self) -> tuple[str, ...]:
        return tuple(tensor.name for tensor in self.inputs)

    @property
    def output_names(self) -> tuple[str, ...]:
        return tuple(tensor.name for tensor in self.outputs)


class Graphs(_Part):
    """The pair. Features leave the blur graph and enter the depth graph under the same names.

    A depth graph may leave out inputs that it has no use for, except ``relative_defocus``. Where there is a ``layout``
    graph it answers, for a map that is put together of several, what the depth graph does for its own.
    """

    blur: GraphFile
    depth: GraphFile
    layout: GraphFile | None = None

    @property
    def feature_names(self) -> tuple[str, ...]:
        """What the depth graph takes from the blur graph."""
        return tuple(name for name in self.depth.input_names if name.startswith(FEATURES_PREFIX))

    @model_validator(mode="after")
    def _fit_together(self) -> Self:
        _require_names("blur graph's inputs", self.blur.input_names, *BLUR_INPUTS)
        _require_names("blur graph's outputs", self.blur.output_names, *BLUR_OUTPUTS, *self.feature_names)
        _require_names("depth graph's inputs", self.depth.input_names, "relative_defocus")
        _require_names("depth graph's outputs", self.depth.output_names, *DEPTH_OUTPUTS)
        if self.layout is not None:
            _require_names("depth graph's outputs", self.depth.output_names, LAYOUT_MAP, LAYOUT_ODDS)
            _require_names("layout graph's inputs", self.layout.input_names, LAYOUT_MAP)
            _require_names("layout graph's outputs", self.layout.output_names, LAYOUT_ODDS)
        if unknown := set(self.depth.input_names) - {*DEPTH_INPUTS, *self.feature_names}:
            raise ValueError(f"the depth graph asks for {sorted(unknown)}, which nothing provides")
        return self


class Interval(NamedTuple):
    """A closed range, in JSON ``[low, high]``."""

    low: float
    high: float


Range = Annotated[Interval, AfterValidator(_require_ordered)]


class Ranges(_Part):
    """What the pair was trained on, in pixels of the image it is given; beyond it answers are a guess.

    ``depth_ratio`` is that of depth to the focus distance; beyond it, or beyond ``blur_px``, there is no answer.
    """

    blur_px: Range
    k_cam_px: Range
    focus_distance_m: Range
    focal_length_px: Range
    gamma_px: Range
    depth_ratio: Range = Interval(0.15, 8.0)


class Training(_Part):
    """Where the weights came from: the commit, the number of steps and the whole configuration."""

    commit: str
    steps: Annotated[int, Field(ge=0)]
    config: dict[str, JsonValue]


class Manifest(_Part):
    """What ``manifest.json`` says.

    ``multiple``: height and width of the image given to the blur graph are multiples of it.
    ``stride``: pixels of the image per pixel of the maps, along each axis. ``blur_gain``: what lambda as the blur graph
    answers it is multiplied with, so that it is neither too high nor too low on the whole. ``temperature``: what stated
    errors of depth are multiplied with, so that they hold what they promise for cameras that were not trained on.
    """

    schema_version: Literal[1] = SCHEMA_VERSION
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$")]
    kind: Literal["compact", "paper"]
    created_at: AwareDatetime
    multiple: Annotated[int, Field(ge=1, le=256)]
    stride: Annotated[int, Field(ge=1, le=16)]
    blur_gain: Annotated[float, Field(gt=0, le=10)] = 1.0
    temperature: Annotated[float, Field(gt=0, le=10)] = 1.0
    graphs: Graphs
    ranges: Ranges
    scores: dict[str, float]
    training: Training
    card: CardFile

    @property
    def files(self) -> list[GraphFile | CardFile]:
        """All that it vouches for."""
        graphs = (self.graphs.blur, self.graphs.depth, self.graphs.layout)
        return [*(graph for graph in graphs if graph is not None), self.card]

    @model_validator(mode="after")
    def _stride_divides_multiple(self) -> Self:
        if self.multiple % self.stride:
            raise ValueError(f"multiple ({self.multiple}) must be a multiple of stride ({self.stride})")
        return self


@dataclass(frozen=True, slots=True)
class ModelFolder:
    """A folder whose files match its manifest."""

    path: Path
    manifest: Manifest

    @property
    def blur_graph(self) -> Path:
        return self.path / self.manifest.graphs.blur.file

    @property
    def depth_graph(self) -> Path:
        return self.path / self.manifest.graphs.depth.file

    @property
    def layout_graph(self) -> Path | None:
        layout = self.manifest.graphs.layout
        return self.path / layout.file if layout else None

    def card(self) -> str:
        """The model card, Markdown."""
        return (self.path / self.manifest.card.file).read_text(encoding="utf-8")


def sha256_of(path: Path) -> str:
    """The file's SHA-256, in lower-case hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def load_model_folder(path: Path) -> ModelFolder:
    """The folder, after every file was compared with the manifest.

    Raises ``ModelFolderError``: no manifest, a manifest of another schema, a missing or altered file.
    """
    folder = path.resolve()
    manifest = _read_manifest(folder / MANIFEST_FILE)
    for part in manifest.files:
        _verify(folder, part.file, part.sha256)
    return ModelFolder(folder, manifest)


def write_manifest(folder: Path, manifest: Manifest) -> Path:
    """Verify the folder against the manifest, then write it: whole or not at all, after everything else.

    Raises ``ModelFolderError`` where a file is missing or differs from what the manifest says of it.
    """
    for part in manifest.files:
        _verify(folder.resolve(), part.file, part.sha256)
    target = folder / MANIFEST_FILE
    draft = folder / f".{MANIFEST_FILE}.part"
    with draft.open("w", encoding="utf-8") as stream:
        stream.write(manifest.model_dump_json(indent=2) + "\n")
        stream.flush()
        os.fsync(stream.fileno())
    draft.replace(target)
    return target


def _read_manifest(path: Path) -> Manifest:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as exc:
        raise ModelFolderError(f"{path} cannot be read: is this a model folder? ({exc})") from exc
    try:
        return Manifest.model_validate_json(text)
    except ValidationError as exc:
        faults = "; ".join(
            f"{'.'.join(map(str, fault['loc'])) or 'the file'}: {fault['msg']}" for fault in exc.errors()
        )
        raise ModelFolderError(f"{path} is no manifest of schema version {SCHEMA_VERSION}: {faults}") from exc


def _verify(folder: Path, name: str, sha256: str) -> None:
    path = folder / name
    if path.resolve().parent != folder:
        raise ModelFolderError(f"{path} points out of the model folder")
    try:
        found = sha256_of(path)
    except OSError as exc:
        raise ModelFolderError(f"{path}, which the manifest names, cannot be read: {exc.strerror}") from exc
    if found != sha256:
        raise ModelFolderError(f"{path} is not the file the manifest vouches for: sha256 {found}, not {sha256}")
