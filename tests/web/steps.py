"""What tests of the page and its pictures do alike."""

import os
import time
from collections.abc import Callable
from pathlib import Path

from playwright.sync_api import Page

from tests.simulated_sheets import GRID

PATIENCE_S = 60
OVERFLOW = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
SHEET = {"Rows": GRID.rows, "Columns": GRID.columns, "Spacing (mm)": GRID.spacing_mm, "Diameter (mm)": GRID.diameter_mm}


def to_photographs(page: Page, name: str, ruler_mm: str = "100") -> None:
    """Say which sheet was printed, and go on to its photographs by a camera of this name."""
    page.goto("#calibrate")
    page.get_by_text("Another grid or paper").click()
    for label, value in SHEET.items():
        page.get_by_label(label, exact=True).fill(f"{value:g}")
    page.get_by_label("Measure this").fill(ruler_mm)
    page.get_by_role("button", name="Next: photographs").click()
    page.get_by_label("Camera", exact=True).fill(name)


def change(file: Path, data: bytes) -> None:
    """Write a file anew so that Chromium knows it for another: it compares the whole second of its time alone."""
    file.write_bytes(data)
    os.utime(file, (0, 0))


def eventually(page: Page, is_so: Callable[[], bool]) -> None:
    """Wait until something is so that no locator can expect; the page goes on meanwhile."""
    give_up = time.monotonic() + PATIENCE_S
    while not is_so():
        assert time.monotonic() < give_up
        page.wait_for_timeout(50)
