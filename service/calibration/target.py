"""The printed grid of circles: where its circles stand, and the sheet in true millimetres as SVG and PDF."""

import io
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray
from reportlab.lib.units import mm
from reportlab.pdfgen.canvas import Canvas

Kind = Literal["asymmetric_circles", "symmetric_circles"]
Paper = Literal["a4", "letter"]

PAPERS_MM: dict[Paper, tuple[float, float]] = {"a4": (210.0, 297.0), "letter": (215.9, 279.4)}
MARGIN_MM = 10.0
NOTES_MM = 32.0
RULER_MM = 100
MIDDLE_TICK_MM = 5
LEAST_GAP_PART = 0.05  # of the spacing
LEAST_PRINTED_GAP_MM = 1.0
TEXT_MM = 3.2
LINE_MM = 4.6
THIN_MM = 0.2
INSTRUCTIONS = (
    "Print at 100 % (no fit to page), glue to a flat board, and check the ruler with a real one.",
    "Take 8 or more photographs that fill the frame, tilted up to 25 degrees, nearer and farther than the focus.",
    "Lock focus, zoom and aperture first; give each circle at least 20 pixels, and expose so that white stays grey.",
)


@dataclass(frozen=True, slots=True)
class CircleGrid:
    """A grid of circles in millimetres. Raises ``ValueError`` if circles touch or a number is not positive.

    In a symmetric grid circle (row i, column j) stands at (j s, i s), in an asymmetric one at ((2j + i mod 2) s, i s),
    as OpenCV has it; s is ``spacing_mm``.
    """

    kind: Kind
    rows: int
    columns: int
    spacing_mm: float
    diameter_mm: float

    def __post_init__(self) -> None:
        if min(self.rows, self.columns) < 2:
            raise ValueError("a grid has at least two rows and two columns")
        if not all(math.isfinite(v) and v > 0 for v in (self.spacing_mm, self.diameter_mm)):
            raise ValueError("spacing_mm and diameter_mm must be positive numbers")
        if self.gap_mm < LEAST_GAP_PART * self.spacing_mm:
            raise ValueError(f"circles of {self.diameter_mm:g} mm that stand {self.nearest_mm:.3g} mm apart touch")

    @property
    def nearest_mm(self) -> float:
        """Distance between the centres of neighbours."""
        return self.spacing_mm * (math.sqrt(2) if self.kind == "asymmetric_circles" else 1.0)

    @property
    def gap_mm(self) -> float:
        """The white between neighbours."""
        return self.nearest_mm - self.diameter_mm

    def points_mm(self) -> NDArray[np.float64]:
        """Centres [rows * columns, 2], x right and y down, row by row from the first circle."""
        row, column = np.divmod(np.arange(self.rows * self.columns), self.columns)
        x = 2 * column + row % 2 if self.kind == "asymmetric_circles" else column
        return np.stack([x, row], 1) * self.spacing_mm

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height with the whole circles."""
        width, height = self.points_mm().max(0) + self.diameter_mm
        return float(width), float(height)


@dataclass(frozen=True, slots=True)
class Text:
    """A line of text whose baseline starts at (x, y)."""

    x_mm: float
    y_mm: float
    words: str


@dataclass(frozen=True, slots=True)
class Sheet:
    """A page in millimetres, y down: black discs, thin lines from (x, y) to (x, y), and text."""

    width_mm: float
    height_mm: float
    discs: tuple[tuple[float, float, float], ...]
    lines: tuple[tuple[float, float, float, float], ...]
    texts: tuple[Text, ...]


def lay_out(grid: CircleGrid, paper: Paper) -> Sheet:
    """The grid in the middle of a sheet, upright or across, above a ruler and notes.

    Raises ``ValueError`` that names the largest spacing that would fit, or where ink would close what is between
    circles.
    """
    if grid.gap_mm < LEAST_PRINTED_GAP_MM:
        raise ValueError(
            f"circles {grid.gap_mm:.2g} mm from each other touch in print, where {LEAST_PRINTED_GAP_MM:g} mm is the "
            "least: so fine a sheet is bought, and its calibration takes the same numbers"
        )
    width, height = grid.size_mm
    for page, room in _pages(paper):
        if width <= room[0] and height <= room[1]:
            return _filled(grid, page, room)
    raise ValueError(f"the grid is {width:.0f} x {height:.0f} mm, too large for {paper}; {_what_fits(grid, paper)}")


def _pages(paper: Paper) -> Iterator[tuple[tuple[float, float], tuple[float, float]]]:
    """The sheet upright and across: its size, and the room for circles on it."""
    for width, height in (PAPERS_MM[paper], PAPERS_MM[paper][::-1]):
        yield (width, height), (width - 2 * MARGIN_MM, height - 2 * MARGIN_MM - NOTES_MM)


def _what_fits(grid: CircleGrid, paper: Paper) -> str:
    width, height = grid.size_mm
    factor = max(min(room[0] / width, room[1] / height) for _, room in _pages(paper))
    spacing_mm = math.floor(grid.spacing_mm * factor * 10) / 10
    if grid.gap_mm / grid.spacing_mm * spacing_mm < LEAST_PRINTED_GAP_MM:
        return "nor does one whose circles do not touch: print fewer rows or columns"
    return f"at most {spacing_mm:.1f} mm spacing fits, with circles made smaller alike"


def _filled(grid: CircleGrid, page: tuple[float, float], room: tuple[float, float]) -> Sheet:
    radius = grid.diameter_mm / 2
    left = MARGIN_MM + (room[0] - grid.size_mm[0]) / 2 + radius
    top = MARGIN_MM + (room[1] - grid.size_mm[1]) / 2 + radius
    discs = tuple((left + float(x), top + float(y), radius) for x, y in grid.points_mm())
    ruler_y = page[1] - MARGIN_MM - 4 * LINE_MM - 4
    ticks = [
        (MARGIN_MM + at, ruler_y, MARGIN_MM + at, ruler_y - (4.0 if at % 10 == 0 else 2.5))
        for at in range(0, RULER_MM + 1, MIDDLE_TICK_MM)
    ]
    name = grid.kind.replace("_", " ")
    told = (
        f"camind, {name}: {grid.rows} rows, {grid.columns} columns, spacing {grid.spacing_mm:g} mm, "
        f"diameter {grid.diameter_mm:g} mm"
    )
    notes = [
        Text(MARGIN_MM, page[1] - MARGIN_MM - (3 - i) * LINE_MM, words) for i, words in enumerate((told, *INSTRUCTIONS))
    ]
    label = Text(MARGIN_MM + RULER_MM + 2, ruler_y, f"{RULER_MM} mm")
    lines = ((MARGIN_MM, ruler_y, MARGIN_MM + RULER_MM, ruler_y), *ticks)
    return Sheet(page[0], page[1], discs, lines, (label, *notes))


def as_svg(sheet: Sheet) -> bytes:
    """The sheet as SVG whose units are millimetres."""
    size = f'width="{sheet.width_mm:g}mm" height="{sheet.height_mm:g}mm"'
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} viewBox="0 0 {sheet.width_mm:g} {sheet.height_mm:g}">',
        '<rect width="100%" height="100%" fill="white"/>',
        *(f'<circle cx="{x:.4f}" cy="{y:.4f}" r="{r:.4f}"/>' for x, y, r in sheet.discs),
        f'<g stroke="black" stroke-width="{THIN_MM}">',
        *(f'<line x1="{a:.4f}" y1="{b:.4f}" x2="{c:.4f}" y2="{d:.4f}"/>' for a, b, c, d in sheet.lines),
        f'</g><g font-family="Helvetica, Arial, sans-serif" font-size="{TEXT_MM}">',
        *(f'<text x="{t.x_mm:.4f}" y="{t.y_mm:.4f}">{escape(t.words)}</text>' for t in sheet.texts),
        "</g></svg>\n",
    ]
    return "\n".join(parts).encode()


def as_pdf(sheet: Sheet) -> bytes:
    """The sheet as a PDF page of its paper's size; the same sheet gives the same bytes."""
    file = io.BytesIO()
    canvas = Canvas(file, pagesize=(sheet.width_mm * mm, sheet.height_mm * mm), invariant=True)
    canvas.setTitle("camind calibration target")
    for x, y, radius in sheet.discs:
        canvas.circle(x * mm, (sheet.height_mm - y) * mm, radius * mm, stroke=0, fill=1)
    canvas.setLineWidth(THIN_MM * mm)
    for x1, y1, x2, y2 in sheet.lines:
        canvas.line(x1 * mm, (sheet.height_mm - y1) * mm, x2 * mm, (sheet.height_mm - y2) * mm)
    canvas.setFont("Helvetica", TEXT_MM * mm)
    for text in sheet.texts:
        canvas.drawString(text.x_mm * mm, (sheet.height_mm - text.y_mm) * mm, text.words)
    canvas.save()
    return file.getvalue()


WRITERS: dict[str, Callable[[Sheet], bytes]] = {".pdf": as_pdf, ".svg": as_svg}
