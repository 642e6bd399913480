"""The model card: what the pair is for, what it was trained on, what it scores. Written, never edited."""

from collections.abc import Mapping
from pathlib import Path

from model_export.config import Kind
from service.inference.artifact import Interval, Ranges, Training, load_model_folder, sha256_of, write_manifest

SOURCES_LEAD = "Pictures that scenes were made of:"
SCORES_HEADING = "## Scores"
GRAPHS = "Two graphs: `blur.onnx` reads blur, `depth.onnx` turns camera-corrected blur into depth"
OF_GRAPHS: dict[Kind, str] = {
    "compact": """; a part of the second is
`layout.onnx` too, for photographs of more than 640 px.""",
    "paper": ".\nThey are the U-Nets of the paper.",
}
OF_PIXELS: dict[Kind, str] = {
    "compact": """an error (`sigma_m`) and a second hypothesis on the other side of focus. Flat, textureless areas carry
no blur to read; there the surroundings are continued and the stated error is large.""",
    "paper": "one depth, on whichever side of focus; its error (`sigma_m`) is not learned.",
}


def card_text(name: str, kind: Kind, ranges: Ranges, training: Training, parameters: int, sources: str) -> str:
    """Markdown of a model that was not evaluated yet."""
    return f"""# {name}

Depth in metres from the defocus blur of one photograph, for any camera whose k_cam and gamma are known.
{GRAPHS}{OF_GRAPHS[kind]} {parameters:,} parameters.

## Use

For static measurements in the range where blur tells distance: a camera's `range_m` says up to where. Every
pixel has {OF_PIXELS[kind]} Not for safety functions.

## Trained on

Drawn and rendered scenes only, no real photograph whose depth was measured: layered surfaces, rooms and views of
furnished rooms, refocused by an occlusion-aware renderer. {training.steps:,} steps in the last of its runs;
docs/training.md says what weights it began with and what it learned from.
Commit `{training.commit}`. Ranges, in pixels of the image that the graphs are given:

| quantity | low | high |
|---|---|---|
{_range_rows(ranges)}

Beyond them an answer is a guess and the service says so in its warnings.

## Licence and sources

Weights: Apache-2.0. {SOURCES_LEAD}

{sources.strip() or "none but what the generator draws"}

{SCORES_HEADING}

Not evaluated yet.
"""


def _range_rows(ranges: Ranges) -> str:
    rows: dict[str, Interval] = {field: getattr(ranges, field) for field in type(ranges).model_fields}
    return "\n".join(f"| `{name}` | {low:g} | {high:g} |" for name, (low, high) in rows.items())


def sources_of(card: str) -> str:
    """Where a card says that the training pictures come from, and under which licence."""
    return card.partition(SOURCES_LEAD)[2].partition(SCORES_HEADING)[0].strip()


def with_scores(card: str, tables: Mapping[str, str], command: str) -> str:
    """The card with its scores replaced by Markdown tables, each under its title."""
    head = card.split(SCORES_HEADING)[0]
    body = "\n\n".join(f"### {title}\n\n{table}" for title, table in tables.items())
    return f"{head}{SCORES_HEADING}\n\nPrinted by `{command}`.\n\n{body}\n"


def record_scores(model: Path, scores: Mapping[str, float], tables: Mapping[str, str], command: str) -> None:
    """Write scores into a model folder: into the card, then, last, into the manifest that vouches for it."""
    folder = load_model_folder(model)
    card = folder.path / folder.manifest.card.file
    text = with_scores(folder.card(), tables, command)
    card.write_text(text)
    vouched = folder.manifest.card.model_copy(update={"sha256": sha256_of(card)})
    write_manifest(folder.path, folder.manifest.model_copy(update={"scores": dict(scores), "card": vouched}))
