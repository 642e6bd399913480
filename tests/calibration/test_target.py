"""The sheet to print: true millimetres, measured on the rendered page."""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pypdfium2
import pytest
from fastapi.testclient import TestClient
from numpy.typing import NDArray
from typer.testing import CliRunner

from service.app import create_app
from service.calibration.target import PAPERS_MM, RULER_MM, CircleGrid, Kind, Paper, Sheet, as_pdf, as_svg, lay_out
from service.cli import app
from service.config import Settings
from service.opencv import cv2

PER_MM = 300 / 25.4
TOLERANCE_MM = 0.05
GRIDS = [
    CircleGrid("asymmetric_circles", 11, 4, 20.0, 12.0),
    CircleGrid("symmetric_circles", 6, 9, 25.0, 15.5),
    CircleGrid("asymmetric_circles", 5, 9, 12.0, 10.0),
]


def rendered(pdf: bytes) -> NDArray[np.uint8]:
    """Grey levels of the page at 300 dpi."""
    page = pypdfium2.PdfDocument(pdf)[0]
    picture = np.asarray(page.render(scale=300 / 72, grayscale=True).to_numpy(), np.uint8)
    return picture.reshape(picture.shape[:2])


def measured(page: NDArray[np.uint8], sheet: Sheet) -> NDArray[np.float64]:
    """Centre and radius in millimetres of the black inside each disc's surroundings, by its grey levels' moments."""
    # the renderer stretches the page to whole pixels
    per_x, per_y = page.shape[1] / sheet.width_mm, page.shape[0] / sheet.height_mm
    found = []
    for x, y, radius in sheet.discs:
        left, top = math.floor((x - radius - 1) * per_x), math.floor((y - radius - 1) * per_y)
        side = math.ceil((2 * radius + 2) * PER_MM)
        black = 1 - page[top : top + side, left : left + side] / 255.0
        rows, columns = np.indices(black.shape) + 0.5
        mass = black.sum()
        centre = ((left + (columns * black).sum() / mass) / per_x, (top + (rows * black).sum() / mass) / per_y)
        found.append((*centre, math.sqrt(mass / math.pi / per_x / per_y)))
    return np.array(found)


@pytest.mark.parametrize("paper", PAPERS_MM)
@pytest.mark.parametrize("grid", GRIDS, ids=lambda g: f"{g.kind}-{g.rows}x{g.columns}")
def test_circles_are_printed_where_and_as_large_as_they_are_told(grid: CircleGrid, paper: Paper) -> None:
    sheet = lay_out(grid, paper)
    page = rendered(as_pdf(sheet))
    assert sorted(page.shape) == pytest.approx(sorted(v * PER_MM for v in PAPERS_MM[paper]), abs=1.5)
    found = measured(page, sheet)
    assert np.abs(found - np.array(sheet.discs)).max() < TOLERANCE_MM
    offsets = found[:, :2] - found[0, :2]
    assert np.abs(offsets - (grid.points_mm() - grid.points_mm()[0])).max() < TOLERANCE_MM


def test_the_ruler_is_as_long_as_it_says() -> None:
    sheet = lay_out(GRIDS[0], "a4")
    page = rendered(as_pdf(sheet))
    left, y, right, _ = sheet.lines[0]
    strip = page[round((y - 0.6) * PER_MM) : round((y + 0.4) * PER_MM), :].min(0)
    dark = np.flatnonzero(strip[: round((right + 1.5) * PER_MM)] < 128) / PER_MM
    assert (dark.max() - dark.min()) == pytest.approx(RULER_MM, abs=0.3)
    assert dark.min() == pytest.approx(left, abs=0.2)


def test_svg_and_pdf_show_the_same_sheet() -> None:
    sheet = lay_out(GRIDS[0], "letter")
    text = as_svg(sheet).decode()
    assert 'width="215.9mm" height="279.4mm" viewBox="0 0 215.9 279.4"' in text
    circles = re.findall(r'<circle cx="([\d.]+)" cy="([\d.]+)" r="([\d.]+)"', text)
    np.testing.assert_allclose(np.array(circles, float), np.array(sheet.discs), atol=1e-3)
    assert "11 rows, 4 columns, spacing 20 mm, diameter 12 mm" in text


def test_all_lies_within_the_page_and_the_text_too() -> None:
    for paper in PAPERS_MM:
        page = rendered(as_pdf(lay_out(GRIDS[1], paper)))
        dark = np.argwhere(page < 200) / PER_MM
        size = np.array(page.shape) / PER_MM
        assert dark.min() > 4
        assert (size - dark.max(0)).min() > 4


def test_opencv_finds_the_grid_in_the_order_of_its_points() -> None:
    grid = GRIDS[0]
    page = rendered(as_pdf(lay_out(grid, "a4")))
    small = np.asarray(cv2.resize(page, None, fx=0.3, fy=0.3, interpolation=cv2.INTER_AREA), np.uint8)
    found, centers = cv2.findCirclesGrid(small, (grid.columns, grid.rows), flags=cv2.CALIB_CB_ASYMMETRIC_GRID)
    assert found
    seen = np.asarray(centers, np.float64).reshape(-1, 2) / (0.3 * PER_MM)
    told = grid.points_mm()
    distances = [np.linalg.norm(points[:, None] - points[None], axis=2) for points in (seen, told)]
    np.testing.assert_allclose(distances[0], distances[1], atol=0.3)


@pytest.mark.parametrize(
    ("kind", "rows", "spacing", "diameter", "why"),
    [
        ("symmetric_circles", 5, 20.0, 19.5, "touch"),
        ("symmetric_circles", 1, 20.0, 10.0, "at least two"),
        ("asymmetric_circles", 5, math.nan, 10.0, "positive"),
    ],
)
def test_a_grid_that_cannot_be_is_refused(kind: Kind, rows: int, spacing: float, diameter: float, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        CircleGrid(kind, rows, 5, spacing, diameter)


def test_circles_a_third_of_a_millimetre_apart_are_a_sheet_of_glass_but_none_to_print() -> None:
    fine = CircleGrid("symmetric_circles", 9, 9, 1.0, 0.7)
    with pytest.raises(ValueError, match=r"0\.3 mm from each other touch in print"):
        lay_out(fine, "a4")


def test_a_grid_too_large_names_the_spacing_that_fits() -> None:
    grid = CircleGrid("symmetric_circles", 10, 10, 40.0, 30.0)
    with pytest.raises(ValueError, match="too large for a4") as caught:
        lay_out(grid, "a4")
    fitting = float(re.findall(r"at most ([\d.]+) mm", str(caught.value))[0])
    lay_out(CircleGrid("symmetric_circles", 10, 10, fitting, fitting * 0.75), "a4")


def test_a_grid_that_fits_at_no_spacing_is_not_told_one() -> None:
    with pytest.raises(ValueError, match="fewer rows or columns"):
        lay_out(CircleGrid("asymmetric_circles", 2, 40, 10.0, 12.0), "a4")


@pytest.fixture(scope="module")
def client() -> TestClient:
    return TestClient(create_app(Settings()))


def test_the_service_hands_out_the_sheet(client: TestClient) -> None:
    options: dict[str, Any] = {
        "kind": "symmetric_circles",
        "rows": 7,
        "columns": 5,
        "spacing_mm": 25,
        "paper": "letter",
    }
    pdf, svg = (client.get(f"/calibrate/target.{kind}", params=options) for kind in ("pdf", "svg"))
    assert (pdf.status_code, pdf.headers["content-type"]) == (200, "application/pdf")
    assert (svg.status_code, svg.headers["content-type"]) == (200, "image/svg+xml")
    assert svg.text.count("<circle") == 35
    assert len(pypdfium2.PdfDocument(pdf.content)) == 1


@pytest.mark.parametrize("query", ["spacing_mm=40", "rows=1", "paper=a0", "diameter_mm=inf"])
def test_a_sheet_that_cannot_be_is_a_problem(client: TestClient, query: str) -> None:
    answer = client.get(f"/calibrate/target.svg?{query}")
    assert answer.status_code == 422
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["errors"][0]["pointer"].endswith(query.split("=")[0])


@pytest.mark.parametrize("name", ["sheet.pdf", "sheet.svg"])
def test_the_command_writes_the_sheet(tmp_path: Path, name: str) -> None:
    result = CliRunner().invoke(app, ["target", "--out", str(tmp_path / name), "--rows", "9"])
    assert result.exit_code == 0, result.output
    assert (tmp_path / name).read_bytes()[:4] in (b"%PDF", b"<svg")


@pytest.mark.parametrize(
    ("options", "said"), [(["--out", "sheet.png"], "must end in"), (["--spacing-mm", "90"], "too large")]
)
def test_the_command_says_what_is_wrong(options: list[str], said: str) -> None:
    result = CliRunner().invoke(app, ["target", *options])
    assert result.exit_code == 2
    assert said in result.output
