"""The calibration in a real browser, on simulated photographs of the sheet: from the print to the camera."""

import math
import re
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from uuid import uuid4

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, Dialog, Page, Route, expect

from model_export.started_server import Server, serving
from service.config import SHIPPED_MODEL
from tests.held_server import HOLD, write_command
from tests.inference.photographs import tiff
from tests.simulated_sheets import CAMERA, DEPTHS_M, GRID, sheet_photos
from tests.web.steps import OVERFLOW, change, eventually, to_photographs
from tests.web.watched import watched

LONG_MS = 120_000
GREY = """(canvas) => {
  const {data} = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  return Array.from({length: data.length / 4}, (_, at) => (data[4 * at] + data[4 * at + 1] + data[4 * at + 2]) / 3);
}"""
# photographs that are decoded at the same time
COUNT_OPENED = """() => {
  const open = createImageBitmap;
  let opened = window.mostOpened = 0;
  window.createImageBitmap = (...about) => {
    window.mostOpened = Math.max(window.mostOpened, ++opened);
    return open(...about).finally(() => opened--);
  };
}"""
K_CAM = {
    "image_width_px": CAMERA.width_px,
    "image_height_px": CAMERA.height_px,
    "focus_distance_m": 0.5,
    "k_cam_px": 3.0,
}
LENS = {"fx_px": 900, "fy_px": 900, "cx_px": 400, "cy_px": 300}


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Of the sheet, nearer and farther than focus, and one of nothing."""
    folder = tmp_path_factory.mktemp("photographs")
    taken = [
        (f"at {z:g} m.jpg", rgb)
        for z, (_, _, rgb) in zip(DEPTHS_M[::2], sheet_photos(CAMERA, DEPTHS_M[::2]), strict=True)
    ]
    taken.append(("nothing.png", np.full((CAMERA.height_px, CAMERA.width_px, 3), 120, np.uint8)))
    for name, rgb in taken:
        cv2.imwrite(str(folder / name), rgb[..., ::-1])
    return [folder / name for name, _ in taken]


@pytest.fixture
def name() -> str:
    """A camera's that nobody had."""
    return f"bench-{uuid4().hex[:8]}"


@pytest.fixture(scope="module")
def data_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("held") / "data"


@pytest.fixture(scope="module")
def served(data_dir: Path) -> Iterator[Server]:
    """A service whose calibrations can be held, for pages that look at one that runs."""
    command = write_command(data_dir.parent, "real")
    with serving(data_dir, "--model", SHIPPED_MODEL, camind=command) as server:
        yield server


@pytest.fixture
def hold(data_dir: Path) -> Path:
    """While this file is there, calibrations are held."""
    hold = data_dir / HOLD
    hold.touch()
    return hold


@pytest.fixture(autouse=True)
def no_calibration(served: Server, data_dir: Path) -> Iterator[None]:
    yield
    (data_dir / HOLD).unlink(missing_ok=True)
    for item in served.ask("GET", "/calibrations").json()["items"]:
        served.ask("DELETE", f"/calibrations/{item['id']}")


def drop(page: Page, *files: Path, role: str = "defocused") -> None:
    page.locator(f"input[data-role={role}]").set_input_files(files)


def test_the_sheet_is_what_the_service_prints(page: Page, served: Server, expected_errors: list[str]) -> None:
    expected_errors.append("status of 422")
    page.goto("#calibrate")
    expect(page.get_by_role("img", name=re.compile("11 rows and 4 columns"))).to_be_visible()
    with page.expect_download() as download:
        page.get_by_role("button", name="Download PDF").click()
    assert download.value.path().read_bytes() == served.ask("GET", "/calibrate/target.pdf").body
    page.get_by_label("Measure this").fill("98,6")
    expect(page.get_by_text("Circles of 11.83 mm, 19.72 mm apart")).to_be_visible()
    page.get_by_text("Another grid or paper").click()
    page.get_by_label("Spacing (mm)").fill("60")
    expect(page.get_by_label("Spacing (mm)")).to_have_accessible_description(re.compile("too large for a4"))
    expect(page.get_by_role("button", name="Download PDF")).to_be_disabled()
    page.get_by_label("Spacing (mm)").fill("6")
    expect(page.get_by_label("Spacing (mm)")).to_have_accessible_description(re.compile("touch"))
    expect(page.get_by_text("There is no such sheet.")).to_be_visible()
    expect(page.get_by_role("button", name="Next: photographs")).to_be_disabled()
    page.reload()  # as a phone does with a page that was long behind its camera
    expect(page.get_by_label("Measure this")).to_have_value("98,6")


def test_a_sheet_too_fine_to_print_here_is_calibrated_with(page: Page, expected_errors: list[str]) -> None:
    expected_errors.append("status of 422")
    page.goto("#calibrate")
    page.get_by_text("Another grid or paper").click()
    page.get_by_label("Diameter (mm)").fill("1.2")
    page.get_by_label("Spacing (mm)").fill("1.5")
    expect(page.get_by_label("Spacing (mm)")).to_have_accessible_description(re.compile("so fine a sheet is bought"))
    expect(page.get_by_role("button", name="Download PDF")).to_be_disabled()
    page.get_by_role("button", name="Next: photographs").click()
    expect(page.get_by_text("Begin with one")).to_be_visible()


def test_a_photograph_that_browsers_do_not_show_is_shown_with_its_circles(
    page: Page, photographs: list[Path], tmp_path: Path, name: str
) -> None:
    pixels = np.asarray(cv2.imread(str(photographs[0]), cv2.IMREAD_COLOR_RGB), np.uint8)
    stuck, scan = tmp_path / "stuck.tiff", tmp_path / "scan.tiff"
    for path in (stuck, scan):
        path.write_bytes(tiff(pixels))
    to_photographs(page, name)
    unanswered: list[Route] = []
    page.route("**/photographs/preview?*", lambda route: route.continue_() if unanswered else unanswered.append(route))
    drop(page, stuck, scan)
    shown = page.get_by_role("img", name="scan.tiff with 21 circles found")
    expect(shown).to_be_visible()
    expected = cv2.resize(pixels, (320, 240), interpolation=cv2.INTER_AREA).mean(2)

    def is_like_it() -> bool:
        drawn = np.array(shown.evaluate(GREY))
        return bool(drawn.size == expected.size and np.corrcoef(drawn, expected.ravel())[0, 1] > 0.9)

    expect(page.get_by_role("list", name="Photographs").get_by_text("found", exact=True)).to_have_count(
        2, timeout=LONG_MS
    )
    assert not is_like_it()
    page.get_by_role("button", name="Remove stuck.tiff").click()
    eventually(page, is_like_it)


def test_every_photograph_says_at_once_what_it_shows(
    page: Page, served: Server, photographs: list[Path], name: str, barriers: Callable[[Page], list[str]]
) -> None:
    camera = {"name": name, **K_CAM, "intrinsics": LENS}
    assert served.add(camera) == 201
    to_photographs(page, name)
    expect(page.get_by_text("Begin with one")).to_be_visible()
    page.evaluate(COUNT_OPENED)
    drop(page, photographs[0], photographs[-1])
    shown = page.get_by_role("list", name="Photographs").get_by_role("listitem")
    near = shown.filter(has_text=photographs[0].name)
    expect(near.get_by_text("found", exact=True)).to_be_visible()
    expect(near.get_by_role("img", name=re.compile("with 21 circles found"))).to_be_visible()
    expect(near).to_contain_text(re.compile(r"Distance0\.3[34]\d* m"))
    expect(near).to_contain_text("Exposuregood")
    nothing = shown.filter(has_text="nothing.png")
    expect(nothing.get_by_text("no grid", exact=True)).to_be_visible()
    expect(nothing).to_contain_text("no grid of dark circles was found")
    expect(page.get_by_role("img", name=re.compile("parts of the frame"))).to_be_visible()
    expect(page.get_by_role("img", name="Blur of each photograph")).to_be_visible()
    # said where it is read, and aloud
    expect(page.get_by_text(re.compile(r"Next: one at [\d.]+\S[\d.]+ m, tilted by 15 to 25 degrees"))).to_have_count(2)
    assert page.evaluate("window.mostOpened") == 1
    assert barriers(page) == []
    nothing.get_by_role("button", name="Remove nothing.png").press("Enter")
    expect(shown).to_have_count(1)
    expect(near.get_by_role("button", name="Remove")).to_be_focused()
    page.set_viewport_size({"width": 360, "height": 740})
    assert page.evaluate(OVERFLOW) <= 0


def test_the_same_photograph_again_is_no_other(page: Page, photographs: list[Path], name: str) -> None:
    to_photographs(page, name)
    shown = page.get_by_role("list", name="Photographs").get_by_role("listitem")
    page.route("**/calibrate/look?*", lambda _: None)  # what was found would be said next
    drop(page, photographs[0])
    expect(shown).to_have_count(1)
    drop(page, *photographs[:2])
    expect(shown).to_have_count(2)
    expect(page.get_by_text("1 photograph was there already.")).to_have_count(2)  # seen, and said aloud
    drop(page, photographs[0], role="focused")
    expect(shown).to_have_count(3)
    # they would be lost where the page is left by mistake, also after a camera was looked at
    page.get_by_role("tab", name="Cameras").click()
    page.get_by_role("button", name="New camera").click()
    page.get_by_role("button", name="Cancel").click()
    page.get_by_role("tab", name="Calibrate").click()
    leaving: list[str] = []

    def stay(dialog: Dialog) -> None:
        leaving.append(dialog.type)
        dialog.dismiss()

    page.once("dialog", stay)
    page.get_by_role("heading", name="Calibrate").click()
    page.evaluate("setTimeout(() => location.reload())")
    eventually(page, lambda: leaving == ["beforeunload"])
    expect(shown).to_have_count(3)


@pytest.mark.parametrize(
    ("orientation", "corner"),
    [(1, "upper left"), (3, "lower right"), (6, "upper right"), (8, "lower left")],
)
def test_a_corner_is_named_as_the_photograph_is_held(page: Page, orientation: int, corner: str) -> None:
    """The circles are in every corner of the stored frames but the upper left one."""
    places = [(595, 5), (5, 395), (595, 395), (300, 200)]
    seen = [
        {
            "role": "defocused",
            "width": 600,
            "height": 400,
            "orientation": orientation,
            "circles": [{"u_px": u, "v_px": v} for u, v in places],
            "blur": 1 + abs(distance - 1),
            "distance": distance,
            "tilt": 15,
        }
        for distance in (0.7, 0.75, 1.0, 1.4, 1.5)
    ]
    page.goto("#calibrate")
    advice = page.evaluate("async (seen) => (await import('/web/guidance.js')).adviceFor(seen, 1)", seen)
    assert advice == f"Next: one with the sheet towards the {corner} corner."


@pytest.mark.parametrize(
    ("blurs", "advice"),
    [
        ([0.48, 0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.82], "Next: one clearly blurred"),
        ([1.8, 1.9, 2.0, 2.1, 2.2, 2.3, 2.4, 2.5], "Next: one in which the sheet is sharper"),
        ([0.5, 0.6, 0.7, 0.8, 1.2, 1.6, 1.8, 2.0], "This is a good set"),
    ],
)
def test_a_set_is_good_where_blur_differs(page: Page, blurs: list[float], advice: str) -> None:
    """Nothing tells the focal length; the sheet is large and small, and in every corner."""
    seen = [
        {
            "role": "defocused",
            "width": 600,
            "height": 400,
            "orientation": 1,
            "circles": [{"u_px": 300 + x * size, "v_px": 200 + y * size} for x in (-290, 290) for y in (-190, 190)],
            "blur": blur,
            "distance": None,
            "tilt": None,
        }
        for blur, size in zip(blurs, (1, 0.9, 0.8, 0.7, 0.6, 0.5, 0.6, 0.7), strict=True)
    ]
    page.goto("#calibrate")
    told = page.evaluate("async (seen) => (await import('/web/guidance.js')).adviceFor(seen, null)", seen)
    assert told.startswith(advice)


@pytest.mark.parametrize(
    ("distances", "advice"),
    [
        ((0.1,), "Next: one farther than the plane in focus."),
        ((0.1, 0.097, 0.096), "Next: one farther than the plane in focus."),
        ((0.1, 0.097, 0.104, 0.105), "Next: one nearer than the plane in focus."),
        ((0.1, 0.097, 0.096, 0.104, 0.105), "Next: 3 more, each at another distance and tilt."),
    ],
)
def test_sides_are_told_apart_by_size_and_blur_where_no_distance_is_known(
    page: Page, distances: tuple[float, ...], advice: str
) -> None:
    """A macro lens' photographs, without EXIF: k_cam is 100 px, and the sheet never 1.25 times as large."""
    seen = [
        {
            "role": "defocused",
            "width": 600,
            "height": 400,
            "orientation": 1,
            "circles": [
                {"u_px": 300 + 28 * x / z, "v_px": 200 + 18 * y / z, "radius_px": 3 / z}
                for x in (-1, 1)
                for y in (-1, 1)
            ],
            "blur": math.hypot(0.6, 100 * (0.1 / z - 1)),
            "distance": None,
            "tilt": None,
        }
        for z in distances
    ]
    page.goto("#calibrate")
    told = page.evaluate("async (seen) => (await import('/web/guidance.js')).adviceFor(seen, null)", seen)
    assert told.replace(", tilted by 15 to 25 degrees", "") == advice


@pytest.mark.parametrize(
    ("distances", "advice"),
    [
        # a third of a circle's radius of blur is 0.012 m away
        ((0.2, 0.195), "Next: one at 0.206 to 0.212 m."),
        ((0.2, 0.195, 0.196, 0.21), "Next: one at 0.206 to 0.212 m."),
        ((0.2, 0.21, 0.205), "Next: one at 0.188 to 0.194 m."),
        ((0.2, 0.195, 0.205, 0.196, 0.21), "Next: one with the sheet towards the lower left corner."),
    ],
)
def test_a_lens_that_blurs_much_is_not_sent_far_away(page: Page, distances: tuple[float, ...], advice: str) -> None:
    seen = [
        {
            "role": "defocused",
            "width": 600,
            "height": 400,
            "orientation": 1,
            "circles": [{"u_px": u, "v_px": v, "radius_px": 36 * 0.2 / z} for u, v in ((5, 5), (595, 5), (595, 395))],
            "blur": math.hypot(0.5, 200 * (0.2 / z - 1)),
            "distance": z,
            "tilt": 15,
        }
        for z in distances
    ]
    page.goto("#calibrate")
    told = page.evaluate("async (seen) => (await import('/web/guidance.js')).adviceFor(seen, null)", seen)
    assert told.replace(", tilted by 15 to 25 degrees", "").replace("\u2013", " to ") == advice


def test_a_result_that_is_not_determined_is_no_success(page: Page, photographs: list[Path], name: str) -> None:
    def widen(route: Route) -> None:
        answer = route.fetch()
        job = answer.json()
        job["result"]["k_cam_px"] |= {"low": 1.0, "high": 4.0}
        route.fulfill(response=answer, json=job)

    def is_shown(is_wide: bool) -> None:
        expect(page.get_by_role("heading", name=f"What was found for {name}")).to_be_visible(timeout=LONG_MS)
        accept = page.get_by_role("button", name="Accept as a new camera")
        expect(accept).to_have_class("" if is_wide else "primary")
        for told in ("not determined well", "k_cam may be anything from 1 to 4 px", "Back to the photographs"):
            expect(page.get_by_text(told)).to_have_count(int(is_wide))

    to_photographs(page, name)
    drop(page, *photographs[:3])
    page.get_by_role("button", name="Start the calibration").click()
    is_shown(is_wide=False)
    page.route(re.compile(r"/calibrations/[^/?]+$"), widen)
    page.reload()
    page.get_by_role("button", name=f"Open the calibration of {name}").click()
    is_shown(is_wide=True)


def test_a_photograph_that_misses_its_place_does_not_replace_the_page(page: Page) -> None:
    page.goto("#calibrate")
    expect(page.get_by_role("heading", name="Calibrate")).to_be_visible()
    assert page.evaluate(
        """() => {
          const given = new DataTransfer();
          given.items.add(new File(["x"], "a.jpg", {type: "image/jpeg"}));
          const drop = (kind) => new DragEvent(kind, {dataTransfer: given, bubbles: true, cancelable: true});
          return ["dragover", "drop"].map((kind) => !document.body.dispatchEvent(drop(kind)));
        }"""
    ) == [True, True]


def test_photographs_that_a_lost_connection_left_out_are_looked_at_together(
    page: Page, photographs: list[Path], name: str, expected_errors: list[str]
) -> None:
    expected_errors.append("net::ERR_")
    to_photographs(page, name)
    page.context.set_offline(True)
    page.get_by_role("button", name="Choose photographs: Focus locked").focus()
    drop(page, *photographs[:2])
    expect(page.get_by_role("status")).to_contain_text("found in 0 of 2 photographs, 2 not looked at.")
    page.context.set_offline(False)
    page.get_by_role("button", name="Look again").first.click()
    expect(page.get_by_text("found", exact=True)).to_have_count(2)


def test_a_file_that_is_no_photograph_is_told(
    page: Page, tmp_path: Path, name: str, expected_errors: list[str]
) -> None:
    expected_errors.extend(["status of 4", "ERR_UPLOAD_FILE_CHANGED"])
    file = tmp_path / "notes.jpg"
    file.write_text("no picture")
    to_photographs(page, name)
    drop(page, file)
    expect(page.get_by_text("not readable")).to_be_visible()
    expect(page.get_by_role("button", name="Look again")).to_have_count(0)
    change(file, b"no picture either")
    page.get_by_role("button", name="Start the calibration").click()
    expect(page.get_by_text("The browser cannot read notes.jpg.")).to_be_visible()


def test_a_set_becomes_a_camera(
    page: Page,
    browser: Browser,
    served: Server,
    photographs: list[Path],
    name: str,
    hold: Path,
    d200: dict[str, Any],
    barriers: Callable[[Page], list[str]],
) -> None:
    served.add(d200)
    to_photographs(page, name, ruler_mm="99")
    drop(page, *photographs)
    page.get_by_label("Focus distance (m)").fill("0.495")
    page.get_by_role("button", name="Start the calibration").click()
    expect(page.get_by_role("heading", name=f"Calibrating {name}")).to_be_visible()
    expect(page.get_by_role("progressbar", name="Progress")).to_be_visible()
    expect(page.get_by_role("row", name=photographs[0].name)).to_contain_text("found")
    # who comes back finds it where it is
    with watched(browser, served.url, []) as other:
        other.goto("#calibrate")
        expect(other.get_by_role("heading", name=f"Calibrating {name}")).to_be_visible()
    hold.unlink()
    expect(page.get_by_role("heading", name=f"What was found for {name}")).to_be_visible(timeout=LONG_MS)
    item = served.ask("GET", "/calibrations?limit=1").json()["items"][0]
    job = served.ask("GET", f"/calibrations/{item['id']}").json()
    assert job["settings"]["pattern"]["spacing_mm"] == pytest.approx(0.99 * GRID.spacing_mm)
    found = job["result"]["k_cam_px"]
    expect(page.get_by_text(f"{found['low']:.4g} to {found['high']:.4g} at 95 %")).to_be_visible()
    expect(page.get_by_role("img", name="Blur of every circle")).to_be_visible()
    expect(page.get_by_role("img", name="What the fit leaves")).to_be_visible()
    expect(page.get_by_text("1 of 4 photographs were of no use")).to_be_visible()
    assert served.ask("GET", f"/cameras/{name}").status == 404
    assert barriers(page) == []
    stored_as = page.get_by_label("Store it as camera")
    stored_as.fill(f"{d200['name']} ")
    becomes = re.compile(f"^It becomes revision .* of {d200['name']}; the others are kept")
    expect(stored_as).to_have_accessible_description(becomes)
    stored_as.fill(name)
    page.get_by_role("button", name="Accept as a new camera").click()
    expect(page.get_by_role("status")).to_have_text(f"Stored as revision 1 of camera {name}.")
    camera = served.ask("GET", f"/cameras/{name}").json()
    assert (camera["source"], camera["k_cam_px"]) == ("calibration", pytest.approx(found["value"]))
    page.get_by_role("button", name="See the camera").click()
    expect(page.get_by_role("heading", name=name)).to_be_visible()
    page.get_by_role("button", name="Measure depth", exact=True).click()
    expect(page.get_by_role("tab", name="Depth")).to_be_focused()


def test_one_that_found_nothing_says_why_and_goes_back(page: Page, photographs: list[Path], name: str) -> None:
    to_photographs(page, name)
    drop(page, photographs[-1])
    page.get_by_role("button", name="Start the calibration").click()
    expect(page.get_by_role("heading", name="The calibration found no camera")).to_be_visible(timeout=LONG_MS)
    expect(page.get_by_role("alert")).to_contain_text("could be measured in none of the photographs")
    page.get_by_role("button", name="Back to the photographs").click()
    expect(page.get_by_role("list", name="Photographs").get_by_role("listitem")).to_have_count(1)


def test_a_running_one_is_cancelled(page: Page, served: Server, photographs: list[Path], name: str, hold: Path) -> None:
    to_photographs(page, name)
    drop(page, *photographs[:3])
    page.get_by_role("button", name="Start the calibration").click()
    page.get_by_role("button", name="Cancel").click()
    expect(page.get_by_role("heading", name="The calibration was cancelled")).to_be_visible()
    newest = served.ask("GET", "/calibrations").json()["items"][0]
    assert (newest["camera"], newest["state"]) == (name, "cancelled")
    expect(page.get_by_role("row", name=re.compile(f"{name}.*cancelled"))).to_be_visible()
    hold.unlink()
    # the same photographs once more are another calibration
    page.get_by_role("button", name="Back to the photographs").click()
    page.get_by_role("button", name="Start the calibration").click()
    expect(page.get_by_role("heading", name=f"What was found for {name}")).to_be_visible(timeout=LONG_MS)
    told = served.ask("GET", "/calibrations").json()["items"]
    assert [one["state"] for one in told if one["camera"] == name] == ["succeeded", "cancelled"]


def test_a_service_that_goes_away_is_told(
    browser: Browser, photographs: list[Path], name: str, tmp_path: Path, tiny_model_dir: Path
) -> None:
    with (
        serving(tmp_path / "data", "--model", tiny_model_dir) as server,
        watched(browser, server.url, ["net::ERR_"]) as page,
    ):
        to_photographs(page, name)
        drop(page, photographs[0])
        expect(page.get_by_text("found", exact=True)).to_be_visible()
        server.stop(signal.SIGKILL)
        drop(page, photographs[1])
        expect(page.get_by_text("not looked at", exact=True)).to_be_visible()
        page.get_by_role("button", name="Start the calibration").click()
        expect(page.get_by_role("alert")).to_contain_text("The service does not answer.")
        # nothing of what was done is lost
        expect(page.get_by_role("list", name="Photographs").get_by_role("listitem")).to_have_count(2)
