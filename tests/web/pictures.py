"""``make pictures``: the page's main states in ``docs/images``, as a real browser shows them at a real service."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

import cv2
from playwright.sync_api import Browser, FilePayload, Page, expect

from model_export.started_server import Server, serving
from tests.d200 import D200
from tests.simulated_sheets import CAMERA, DEPTHS_M, sheet_photos
from tests.web.chromium import running_browser
from tests.web.steps import to_photographs
from tests.web.watched import watched

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "docs" / "images"
COFFEE = ROOT / "docs" / "pictures" / "coffee.jpg"
MOST_BYTES = 200_000
JPEG_QUALITY = 85
CALIBRATION_MS = 300_000
SHEET_DEPTHS_M = DEPTHS_M[::2]


@dataclass(frozen=True)
class Picture:
    """A state of the page: where it opens, and what is done there until it shows what it should."""

    name: str  # .png, or .jpg where a photograph would make that large
    tab: str
    show: Callable[[Page], None]
    scheme: Literal["light", "dark"] = "light"
    width_px: int = 1280
    height_px: int = 900

    def take(self, browser: Browser, url: str) -> bytes:
        size = {"width": self.width_px, "height": self.height_px}
        person = {"locale": "en-GB", "timezone_id": "UTC"}
        with watched(browser, url, [], viewport=size, color_scheme=self.scheme, **person) as page:
            page.goto(f"#{self.tab}")
            self.show(page)
            if self.name.endswith(".jpg"):
                return page.screenshot(type="jpeg", quality=JPEG_QUALITY)
            return page.screenshot()


def status(page: Page) -> None:
    """Ready, with figures of the photographs that were answered."""
    expect(page.get_by_text("Ready", exact=True)).to_be_visible()
    expect(page.get_by_role("row", name="Depth graph")).to_be_visible()
    expect(page.get_by_role("row", name="plane 1 m")).to_be_visible()


def depth(page: Page) -> None:
    """A photograph half uncovered from its depth, two points measured, the pointer on a third."""
    page.get_by_role("combobox", name="Camera", exact=True).select_option("d200")
    page.get_by_role("combobox", name="Side of the plane in focus").select_option("near")
    page.locator(".depth input[type=file]").first.set_input_files(COFFEE)
    picture = page.get_by_role("application", name="Depth of the photograph")
    expect(page.locator("[data-picture=depth]")).to_be_visible()
    box = picture.bounding_box()
    assert box is not None
    page.get_by_role("slider", name="Part of the picture").fill("38")
    for x, y in ((0.44, 0.3), (0.8, 0.75)):
        picture.click(position={"x": x * box["width"], "y": y * box["height"]})
    picture.hover(position={"x": 0.62 * box["width"], "y": 0.2 * box["height"]})
    expect(page.locator("[data-label=distance]")).to_be_visible()
    expect(page.locator("[data-label=reading]")).to_be_visible()


def depth_3d(page: Page) -> None:
    """The same photograph as points in space."""
    depth(page)
    page.get_by_role("tab", name="3D").click()
    expect(page.locator(".depth-cloud[data-points]")).to_be_visible()
    # submitted is not yet on the screen
    page.wait_for_timeout(1000)


def cameras(page: Page) -> None:
    """A camera known by its lens: what it comes to, and its blur against distance."""
    page.get_by_role("button", name="d200").click()
    expect(page.get_by_role("img", name="Blur against distance")).to_be_visible()


def photographs(page: Page) -> None:
    """Photographs of a simulated sheet, each with what was found in it."""
    to_photographs(page, "bench")
    page.locator("input[data-role=defocused]").set_input_files(simulated_photographs())
    shown = page.get_by_role("list", name="Photographs")
    expect(shown.get_by_text("found", exact=True)).to_have_count(len(SHEET_DEPTHS_M), timeout=CALIBRATION_MS)


def calibration(page: Page) -> None:
    """What a calibration found."""
    photographs(page)
    page.get_by_role("button", name="Start the calibration").click()
    expect(page.get_by_role("heading", name="What was found for bench")).to_be_visible(timeout=CALIBRATION_MS)
    expect(page.get_by_role("img", name="Blur of every circle")).to_be_visible()


@cache
def simulated_photographs() -> list[FilePayload]:
    """Of a sheet before a lens of our own making."""
    taken = zip(SHEET_DEPTHS_M, sheet_photos(CAMERA, SHEET_DEPTHS_M), strict=True)
    return [
        {
            "name": f"at {depth_m:g} m.jpg",
            "mimeType": "image/jpeg",
            "buffer": cv2.imencode(".jpg", rgb[..., ::-1])[1].tobytes(),
        }
        for depth_m, (_, _, rgb) in taken
    ]


PICTURES = (
    Picture("depth.jpg", "depth", depth, width_px=1120, height_px=860),
    Picture("depth-dark.jpg", "depth", depth, scheme="dark", width_px=1120, height_px=860),
    Picture("depth-narrow.jpg", "depth", depth, width_px=360, height_px=1100),
    Picture("depth-3d.jpg", "depth", depth_3d, width_px=1120, height_px=860),
    Picture("cameras.png", "cameras", cameras),
    Picture("calibrate.jpg", "calibrate", photographs, height_px=1200),
    Picture("calibration.jpg", "calibrate", calibration, height_px=1200),
    Picture("status.png", "status", status),
)


def prepare(server: Server) -> None:
    """What the pictures show: a camera, and some photographs answered."""
    server.add(D200 | {"description": "Nikon D200, 35 mm at f/2.8, focused at 2 m"})
    for _ in range(4):
        server.ask("POST", "/depth?camera=d200", COFFEE.read_bytes(), {"Content-Type": "image/jpeg"})


def main() -> None:
    """Take every picture, and leave none of those before."""
    IMAGES.mkdir(exist_ok=True)
    for old in IMAGES.iterdir():
        old.unlink()
    with (
        tempfile.TemporaryDirectory() as folder,
        serving(Path(folder) / "data") as server,
        running_browser() as browser,
    ):
        prepare(server)
        for picture in PICTURES:
            (IMAGES / picture.name).write_bytes(picture.take(browser, server.url))


if __name__ == "__main__":
    main()
