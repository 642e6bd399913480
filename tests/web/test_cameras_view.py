"""Cameras in a real browser: made, changed against another's change, deleted, exported and imported."""

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
from playwright.sync_api import Dialog, Page, Route, expect

from model_export.started_server import Server
from service.optics.thin_lens import depth_at_focus
from tests.web.steps import OVERFLOW, eventually

JSON = {"Content-Type": "application/json"}
LENS = {"Focal length (mm)": "35", "f-number": "2.8", "Pixel pitch (µm)": "6.05", "Sensor width (px)": "3872"}
LENS_OF_ITS_SIZE = {"fx_px": 3000, "fy_px": 3000, "cx_px": 2000, "cy_px": 1500}
FRAME = {"Image width (px)": "645", "Image height (px)": "432", "Focus distance (m)": "2"}


def forget_cameras(served: Server) -> None:
    for camera in served.ask("GET", "/cameras").json()["items"]:
        served.ask("DELETE", f"/cameras/{camera['name']}")


@pytest.fixture(autouse=True)
def no_cameras(served: Server) -> Iterator[None]:
    forget_cameras(served)  # those of other files' tests
    yield
    forget_cameras(served)


@pytest.fixture
def phone(phone: dict[str, Any]) -> dict[str, Any]:
    """One whose name nobody had, for revisions are never counted anew."""
    return phone | {"name": f"phone-{uuid4().hex[:8]}"}


def fill(page: Page, fields: dict[str, str]) -> None:
    for label, text in fields.items():
        page.get_by_label(label, exact=True).fill(text)


def read(served: Server, name: str) -> dict[str, Any]:
    return served.ask("GET", f"/cameras/{name}").json()


def open_camera(page: Page, served: Server, camera: dict[str, Any]) -> None:
    assert served.add(camera) == 201
    page.goto("#cameras")
    page.get_by_role("button", name=camera["name"]).click()


def test_a_camera_is_made_from_its_lens_while_it_says_what_it_can_measure(
    page: Page, served: Server, d200: dict[str, Any], barriers: Callable[[Page], list[str]]
) -> None:
    page.goto("#cameras")
    page.get_by_role("button", name="New camera").click()
    live = page.get_by_label("What these numbers come to")
    expect(live).to_contain_text("Fill in image width")
    fill(page, FRAME | LENS | {"Name": "d200"})
    expected = served.ask("POST", "/cameras/preview", json.dumps(d200), JSON).json()
    expect(live).to_contain_text(f"{expected['k_cam_px']:.4g}")
    expect(live).to_contain_text(f"{expected['range_m']['far']:.3g}")
    expect(live.get_by_role("img", name="Blur against distance")).to_be_visible()
    live.get_by_text("As a table").click()
    assert live.get_by_role("row").count() > 20
    assert barriers(page) == []
    page.get_by_role("button", name="Create camera").click()
    expect(page.get_by_role("heading", name="d200")).to_be_visible()
    assert read(served, "d200")["lens"] == {**d200["lens"], "k_r": 4.0}


def test_a_fault_is_shown_at_its_field(page: Page, expected_errors: list[str]) -> None:
    expected_errors.append("status of 422")
    page.goto("#cameras")
    page.get_by_role("button", name="New camera").click()
    fill(page, FRAME | LENS | {"Name": "no name", "f-number": "wide"})
    aperture = page.get_by_label("f-number")
    expect(aperture).to_have_attribute("aria-invalid", "true")
    expect(aperture).to_have_accessible_description("this must be a number")
    fill(page, {"f-number": "2,8"})
    expect(aperture).to_have_attribute("aria-invalid", "false")
    page.get_by_role("button", name="Create camera").click()
    expect(page.get_by_label("Name", exact=True)).to_have_attribute("aria-invalid", "true")
    fill(page, {"Focal length (mm)": "3500"})
    expect(page.get_by_label("Focal length (mm)")).to_have_accessible_description(re.compile("cannot focus at 2 m"))


def test_k_cam_is_moved_with_the_focus_distance(page: Page, served: Server, phone: dict[str, Any]) -> None:
    open_camera(page, served, phone | {"f_number": 1.85})
    expect(page.get_by_text("f/1.85", exact=True)).to_be_visible()
    page.get_by_role("button", name="Edit", exact=True).click()
    k_cam, focus = page.get_by_label("k_cam (px)"), page.get_by_label("Focus distance (m)")
    told = page.get_by_text("This k_cam holds at a focus distance of")
    expect(k_cam).to_have_value(f"{phone['k_cam_px']:g}")
    for focus_distance_m in (phone["focus_distance_m"] / 2, phone["focus_distance_m"] / 4):
        expect(told).to_have_count(0)
        focus.fill(f"{focus_distance_m:g}")
        expect(told).to_contain_text(f"at {focus_distance_m:g} m it is")
        told.get_by_role("button").click()
        moved = phone["k_cam_px"] * phone["focus_distance_m"] / focus_distance_m
        expect(k_cam).to_have_value(f"{moved:.6g}")
    page.get_by_role("button", name="Save as a new revision").click()
    expect(page.get_by_text("revision 2", exact=True)).to_be_visible()
    saved = read(served, phone["name"])
    assert (saved["k_cam_px"], saved["f_number"]) == (pytest.approx(moved, rel=1e-5), 1.85)


@pytest.mark.parametrize(
    ("typed", "numbers"),
    [
        ("-0,21 0,08 0,001 -0,002", [-0.21, 0.08, 0.001, -0.002]),
        ("-0,21; 8e-2;0; -.5", [-0.21, 0.08, 0, -0.5]),
        ("-0.21, 0.08,\n0, 1", [-0.21, 0.08, 0, 1]),
        ("-0.21,0.08,0,0", [-0.21, 0.08, 0, 0]),
        (" ", []),
        ("0,1,0,2", None),
        ("0,1, 0,2", None),
        ("0,1 0,2,0,3", None),
        ("0.1,0.2 0,3", None),
    ],
)
def test_commas_are_decimal_where_spaces_separate(page: Page, typed: str, numbers: list[float] | None) -> None:
    page.goto("#cameras")
    asked = "async (typed) => (await import('/web/camera_specs.js')).numbersOf(typed)"
    assert page.evaluate(asked, typed) == numbers


def test_commas_that_may_be_either_are_a_fault(
    page: Page, served: Server, phone: dict[str, Any], expected_errors: list[str]
) -> None:
    expected_errors.append("status of 422")
    open_camera(page, served, phone | {"intrinsics": LENS_OF_ITS_SIZE})
    expect(page.get_by_text("cy 1500", exact=False)).to_be_visible()
    page.get_by_role("button", name="Edit", exact=True).click()
    page.get_by_text("More: gamma").click()
    distortion = page.get_by_label("Distortion")
    distortion.fill("-0,21,0,08,0,001,-0,002")
    expect(distortion).to_have_accessible_description(re.compile("not clear which commas"))
    page.get_by_role("button", name="Save as a new revision").click()
    expect(page.get_by_role("alert")).to_be_visible()
    distortion.fill("-0,21 0,08 0,001 -0,002")
    page.get_by_role("button", name="Save as a new revision").click()
    expect(page.get_by_text("revision 2", exact=True)).to_be_visible()
    assert read(served, phone["name"])["intrinsics"]["distortion"] == [-0.21, 0.08, 0.001, -0.002]


def test_a_camera_that_is_not_there_is_said_to_be_missing(page: Page) -> None:
    for tab in ("cameras", "depth"):
        page.goto(f"#{tab}/nosuch")
        expect(page.get_by_role("tabpanel").get_by_text("There is no camera nosuch.")).to_be_visible()


def test_what_is_stored_is_shown_where_the_list_does_not_come_again(
    page: Page, served: Server, phone: dict[str, Any], expected_errors: list[str]
) -> None:
    expected_errors.append("ERR_FAILED")
    open_camera(page, served, phone)
    page.get_by_role("button", name="Edit", exact=True).click()
    fill(page, {"k_cam (px)": "1.7"})
    page.route("**/cameras?*", lambda route: route.abort(), times=1)
    page.get_by_role("button", name="Save as a new revision").click()
    expect(page.get_by_role("alert")).to_contain_text("The service does not answer.")
    expect(page.get_by_role("article")).to_contain_text("1.7 px")
    expect(page.get_by_text("There is no camera")).to_have_count(0)
    page.get_by_role("button", name="Try again").click()
    expect(page.get_by_role("alert").filter(visible=True)).to_have_count(0)
    expect(page.get_by_role("listitem")).to_have_count(1)


def test_a_name_that_is_taken_is_told(
    page: Page, served: Server, phone: dict[str, Any], expected_errors: list[str]
) -> None:
    expected_errors.append("status of 409")
    served.add(phone)
    page.set_viewport_size({"width": 360, "height": 740})
    page.goto("#cameras")
    page.get_by_role("button", name="New camera").click()
    page.get_by_label("k_cam", exact=True).check()
    fill(page, FRAME | {"Name": phone["name"], "k_cam (px)": "2"})
    page.get_by_role("button", name="Create camera").press("Enter")
    expect(page.get_by_role("alert").locator("strong")).to_be_in_viewport()
    expect(page.locator(":focus").get_by_role("alert")).to_be_visible()
    expect(page.get_by_label("Name", exact=True)).to_have_accessible_description(
        "This name is taken: open that camera to change it."
    )
    expect(page.get_by_role("alert")).not_to_contain_text(re.compile("PUT|#/"))


@pytest.mark.parametrize("keeps_mine", [True, False])
def test_another_s_change_is_shown_and_one_chooses(
    page: Page, served: Server, phone: dict[str, Any], expected_errors: list[str], keeps_mine: bool
) -> None:
    expected_errors.append("status of 412")
    open_camera(page, served, phone)
    page.get_by_role("button", name="Edit").click()
    fill(page, {"Focus distance (m)": "3"})
    path = f"/cameras/{phone['name']}"
    served.ask("PUT", path, json.dumps(phone | {"k_cam_px": 1.7, "focus_distance_m": 2.5}), JSON)
    page.get_by_role("button", name="Save as a new revision").click()
    told = page.get_by_role("alert").filter(has_text="was changed while you edited it")
    expect(told.get_by_role("row", name="focus_distance_m")).to_contain_text("2.53")
    expect(told.get_by_role("row", name="k_cam_px")).to_contain_text("1.311.71.31")
    assert read(served, phone["name"])["revision"] == 2
    if keeps_mine:
        page.get_by_role("button", name="Store mine as revision 3").click()
        expect(page.get_by_text("revision 3").first).to_be_visible()
        stored = read(served, phone["name"])
        assert (stored["k_cam_px"], stored["focus_distance_m"]) == (1.31, 3)
    else:
        page.get_by_role("button", name="Take what is stored").click()
        expect(page.get_by_label("Focus distance (m)")).to_have_value("2.5")
        page.get_by_role("button", name="Save as a new revision").click()
        expect(page.get_by_text("revision 3").first).to_be_visible()
        assert read(served, phone["name"])["k_cam_px"] == 1.7


def test_a_camera_that_was_deleted_meanwhile_is_stored_anew(
    page: Page, served: Server, phone: dict[str, Any], expected_errors: list[str]
) -> None:
    expected_errors.append("status of 404")
    open_camera(page, served, phone)
    page.get_by_role("button", name="Edit").click()
    fill(page, {"k_cam (px)": "1,7"})
    served.ask("DELETE", f"/cameras/{phone['name']}")
    page.get_by_role("button", name="Save as a new revision").click()
    expect(page.get_by_role("alert")).to_contain_text("There is no camera")
    page.get_by_role("button", name="Create camera").click()
    expect(page.get_by_role("article")).to_contain_text("1.7 px")
    assert read(served, phone["name"])["k_cam_px"] == 1.7


def test_a_curve_that_did_not_come_can_be_asked_for_again(
    page: Page, served: Server, phone: dict[str, Any], expected_errors: list[str]
) -> None:
    expected_errors.append("ERR_FAILED")
    page.route("**/curve", lambda route: route.abort(), times=1)
    open_camera(page, served, phone)
    page.get_by_role("article").get_by_role("button", name="Try again").click()
    expect(page.get_by_role("img", name="Blur against distance")).to_be_visible()
    expect(page.get_by_role("alert").filter(visible=True)).to_have_count(0)


@pytest.mark.parametrize(
    ("asked", "opened", "pressed"), [("curve", None, "Edit"), ("cameras/preview", "Edit", "Save as a new revision")]
)
def test_what_one_presses_stays_where_it_is_when_the_curve_arrives(
    page: Page, served: Server, d200: dict[str, Any], asked: str, opened: str | None, pressed: str
) -> None:
    held: list[Route] = []

    def hold(route: Route) -> None:
        held.append(route)

    page.route(f"**/{asked}*", hold)
    with page.expect_request(f"**/{asked}*"):
        open_camera(page, served, d200)
        if opened:
            page.get_by_role("button", name=opened).click()
    button = page.get_by_role("button", name=pressed)
    before = button.bounding_box()
    held[0].continue_()
    expect(page.get_by_role("img", name="Blur against distance")).to_be_visible()
    assert button.bounding_box() == before


def test_revisions_say_what_changed(page: Page, served: Server, phone: dict[str, Any]) -> None:
    served.add(phone)
    served.ask("PUT", f"/cameras/{phone['name']}", json.dumps(phone | {"k_cam_px": 1.7}), JSON)
    page.goto(f"#cameras/{phone['name']}")
    page.get_by_text("Revisions", exact=True).click()
    expect(page.get_by_text("k_cam_px 1.31 → 1.7")).to_be_visible()


def test_a_camera_is_deleted_after_a_question(page: Page, served: Server, phone: dict[str, Any]) -> None:
    open_camera(page, served, phone)
    page.get_by_role("button", name="Delete", exact=True).click()
    dialog = page.get_by_role("dialog", name=f"Delete {phone['name']}?")
    expect(dialog).to_be_visible()
    page.keyboard.press("Escape")
    expect(dialog).to_be_hidden()
    assert read(served, phone["name"])["revision"] == 1
    page.get_by_role("button", name="Delete", exact=True).click()
    dialog.get_by_role("button", name=f"Delete {phone['name']}").press("Enter")
    expect(page.get_by_role("button", name=phone["name"])).to_have_count(0)
    expect(page.locator("main :focus")).to_have_count(1)
    assert served.ask("GET", f"/cameras/{phone['name']}").status == 404


def test_a_camera_that_was_changed_meanwhile_is_not_deleted_unseen(
    page: Page, served: Server, phone: dict[str, Any], expected_errors: list[str]
) -> None:
    expected_errors.append("status of 412")
    open_camera(page, served, phone)
    served.ask("PUT", f"/cameras/{phone['name']}", json.dumps(phone | {"k_cam_px": 1.7}), JSON)
    page.get_by_role("button", name="Delete", exact=True).click()
    dialog = page.get_by_role("dialog", name=f"Delete {phone['name']}?")
    dialog.get_by_role("button", name=f"Delete {phone['name']}").click()
    expect(dialog.get_by_role("alert")).to_be_visible()
    expect(dialog.get_by_role("button", name="Try again")).to_have_count(0)
    dialog.get_by_role("button", name="See how it is now").click()
    expect(dialog).to_be_hidden()
    expect(page.get_by_text("revision 2", exact=True)).to_be_visible()


def test_what_is_exported_comes_back_after_it_is_shown(
    page: Page,
    served: Server,
    d200: dict[str, Any],
    phone: dict[str, Any],
    tmp_path: Path,
    expected_errors: list[str],
    barriers: Callable[[Page], list[str]],
) -> None:
    expected_errors.append("status of 422")
    served.add(d200)
    served.add(phone | {"f_number": 1.85})
    page.goto("#cameras")
    expect(page.get_by_role("button", name="d200")).to_be_visible()
    with page.expect_download() as download:
        page.get_by_role("button", name="Export all").click()
    exported = json.loads(download.value.path().read_text())["cameras"]
    assert {camera["name"] for camera in exported} == {"d200", phone["name"]}
    served.ask("DELETE", "/cameras/d200")
    page.reload()
    changed = {**exported[1], "k_cam_px": 2.5}
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps([exported[0], changed, {**phone, "name": "bad", "gamma_px": -1}]))
    page.get_by_label("Cameras to import").set_input_files(file)
    plan = page.get_by_role("dialog", name="Import cameras")
    expect(plan.get_by_role("row", name="d200")).to_contain_text("new")
    expect(plan.get_by_role("row", name=phone["name"])).to_contain_text("k_cam_px: revision 1 becomes 2")
    expect(plan.get_by_role("row", name="bad")).to_contain_text("refused gamma_px")
    assert barriers(page) == []
    assert served.ask("GET", "/cameras/d200").status == 404
    plan.get_by_role("button", name="Import 2 cameras").click()
    expect(plan.get_by_role("row", name=phone["name"])).to_contain_text("as revision 2")
    expect(plan.get_by_role("status")).to_have_text("2 cameras are stored, 1 refused")
    plan.get_by_role("button", name="Close").click()
    expect(page.get_by_role("button", name="d200")).to_be_visible()
    stored = read(served, phone["name"])
    assert (stored["k_cam_px"], stored["f_number"]) == (2.5, 1.85)


def test_an_import_says_first_that_the_service_does_not_answer(
    page: Page, phone: dict[str, Any], tmp_path: Path, expected_errors: list[str]
) -> None:
    expected_errors.append("ERR_FAILED")
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps(phone))
    page.goto("#cameras")
    expect(page.get_by_text("There is no camera yet.")).to_be_visible()
    plan = page.get_by_role("dialog", name="Import cameras")
    page.route("**/cameras?*", lambda route: route.abort(), times=1)
    page.get_by_label("Cameras to import").set_input_files(file)
    expect(plan.get_by_role("alert")).to_have_text(re.compile(r"^\s*The service does not answer\. Check that it runs"))
    plan.get_by_role("button", name="Cancel").click()
    expect(page.locator("#import-title")).to_have_count(0)  # what is closed tells the page so a moment later
    page.get_by_label("Cameras to import").set_input_files(file)
    page.route("**/cameras", lambda route: route.abort(), times=1)
    plan.get_by_role("button", name="Import 1 camera").click()
    expect(plan.get_by_role("row", name=phone["name"])).to_contain_text("refused The service does not answer. Check")
    expect(plan.get_by_role("status")).to_have_text("0 cameras are stored, 1 refused")


def test_a_file_that_is_none_is_refused(page: Page, tmp_path: Path) -> None:
    file = tmp_path / "cameras.json"
    file.write_text("metres")
    page.goto("#cameras")
    page.get_by_label("Cameras to import").set_input_files(file)
    expect(page.get_by_role("dialog")).to_contain_text("is no JSON")


def test_a_photograph_fills_the_form_in(page: Page) -> None:
    page.goto("#cameras")
    page.get_by_role("button", name="New camera").click()
    page.get_by_label("Fill in from a photograph it took").set_input_files(
        Path(__file__).parents[2] / "docs/pictures/coffee.jpg"
    )
    expect(page.get_by_label("Image width (px)")).not_to_have_value("")
    expect(page.get_by_text("focus_distance_m is needed")).to_be_visible()


def test_a_photograph_that_was_made_small_leaves_the_sensor_as_it_was_typed(page: Page) -> None:
    page.goto("#cameras")
    page.get_by_role("button", name="New camera").click()
    fill(page, {"Sensor width (px)": "3872"})
    page.get_by_label("Fill in from a photograph it took").set_input_files(
        Path(__file__).parents[2] / "docs/pictures/coffee.jpg"
    )
    expect(page.get_by_label("Image width (px)")).to_have_value("645")
    expect(page.get_by_label("Sensor width (px)")).to_have_value("3872")


def test_a_photograph_takes_nothing_away_that_was_measured(page: Page, served: Server, phone: dict[str, Any]) -> None:
    open_camera(page, served, phone | {"gamma_px": 0.83, "intrinsics": LENS_OF_ITS_SIZE})
    page.get_by_role("button", name="Edit", exact=True).click()
    page.get_by_text("More: gamma").click()
    expect(page.get_by_label("fx (px)")).to_have_value("3000")
    page.get_by_label("Fill in from a photograph it took").set_input_files(
        Path(__file__).parents[2] / "docs/pictures/coffee.jpg"
    )
    expect(page.get_by_label("fx (px)")).to_have_value("")  # of another size of picture
    expect(page.get_by_label("Name", exact=True)).to_have_value(phone["name"])
    expect(page.get_by_label("gamma (px)")).to_have_value("0.83")


def test_the_way_back_leaves_an_edit_as_it_is(page: Page, served: Server, phone: dict[str, Any]) -> None:
    assert served.add(phone) == 201
    page.goto("")
    page.goto(f"#cameras/{phone['name']}")
    page.get_by_role("button", name="Edit", exact=True).click()
    page.get_by_label("Focus distance (m)").fill("1.23")
    page.get_by_role("tab", name="Status").click()
    page.go_back()
    expect(page.get_by_label("Focus distance (m)")).to_have_value("1.23")


def test_a_camera_that_is_opened_is_in_sight_and_in_the_address(
    page: Page, served: Server, phone: dict[str, Any]
) -> None:
    names = [f"{phone['name']}-{number}" for number in range(12)]
    for name in names:
        assert served.add(phone | {"name": name}) == 201
    page.set_viewport_size({"width": 390, "height": 844})
    page.goto("#cameras")
    for name in (names[0], names[3]):
        page.get_by_role("button", name=name, exact=False).first.click()
        title = page.get_by_role("heading", name=name, exact=True)
        expect(title).to_be_in_viewport()
        expect(title).to_be_focused()
        assert page.url.endswith(f"#cameras/{name}")
    # once more, after a look at the list
    page.evaluate("scrollTo(0, 0)")
    page.get_by_role("button", name=names[3]).click()
    expect(page.get_by_role("heading", name=names[3], exact=True)).to_be_in_viewport()
    page.reload()
    expect(page.get_by_role("heading", name=names[3], exact=True)).to_be_visible()
    page.go_back()
    expect(page.get_by_role("heading", name=names[0], exact=True)).to_be_visible()
    page.get_by_role("tab", name="Status").click()
    page.get_by_role("tab", name="Cameras").click()
    assert page.url.endswith(f"#cameras/{names[0]}")
    page.go_back()
    page.go_back()
    page.go_back()
    expect(page.get_by_text("Choose a camera to see what it can measure.")).to_be_visible()


def test_what_is_typed_is_not_thrown_away_unasked(page: Page, served: Server, phone: dict[str, Any]) -> None:
    other = f"{phone['name']}-other"
    for name in (phone["name"], other):
        assert served.add(phone | {"name": name}) == 201
    page.goto(f"#cameras/{phone['name']}")
    page.get_by_role("button", name="Edit", exact=True).click()
    focus = page.get_by_label("Focus distance (m)")
    focus.fill("1,23")
    asked: list[str] = []

    def decline(dialog: Dialog) -> None:
        asked.append(dialog.message)
        dialog.dismiss()

    page.once("dialog", decline)
    page.get_by_role("button", name=other).click()
    eventually(page, lambda: asked == ["Throw away what you have typed?"] and page.url.endswith(f"/{phone['name']}"))
    expect(focus).to_have_value("1,23")
    leaving: list[str] = []

    def leave(dialog: Dialog) -> None:
        leaving.append(dialog.type)
        dialog.accept()

    page.once("dialog", leave)
    page.reload()
    assert leaving == ["beforeunload"]
    page.get_by_role("button", name="Edit", exact=True).click()
    focus.fill("1,23")
    page.once("dialog", lambda dialog: dialog.accept())
    page.get_by_role("button", name=other).click()
    expect(page.get_by_role("heading", name=other, exact=True)).to_be_visible()
    # nothing is typed, nothing is asked
    page.get_by_role("button", name="Edit", exact=True).click()
    page.get_by_role("button", name=phone["name"]).first.click()
    expect(page.get_by_role("heading", name=phone["name"], exact=True)).to_be_visible()
    page.once("dialog", leave)
    page.reload()
    assert leaving == ["beforeunload"]


def test_a_range_ends_where_answers_end(page: Page, served: Server, phone: dict[str, Any]) -> None:
    ranges = served.ask("GET", "/model").json()["manifest"]["ranges"]
    (nearest, farthest), (_, known_m) = ranges["depth_ratio"], ranges["focus_distance_m"]
    strong = phone | {"name": f"{phone['name']}-strong", "k_cam_px": 300.0, "focus_distance_m": 2.0}
    weak = phone | {"name": f"{phone['name']}-weak", "k_cam_px": 0.05, "focus_distance_m": 2.0}
    beyond = phone | {"name": f"{phone['name']}-beyond", "k_cam_px": 300.0, "focus_distance_m": 20.0}
    for camera in (strong, weak, beyond):
        assert served.add(camera) == 201
    assert read(served, strong["name"])["range_m"]["far"] > farthest * 2
    # focused farther than the networks know, it is read by the camera that blurs alike
    begins_m = depth_at_focus(nearest * known_m, known_m, 20.0)
    for camera, words in (
        (strong, f"{nearest * 2:g} to {farthest * 2:g} m"),
        (weak, "none"),
        (beyond, f"{begins_m:.3g} to {farthest * 20:g} m"),
    ):
        page.goto(f"#cameras/{camera['name']}")
        expect(page.get_by_role("heading", name=camera["name"])).to_be_visible()
        expect(page.locator(".figures div").filter(has_text="Usable range").get_by_role("definition")).to_have_text(
            words
        )
    page.goto(f"#depth/{strong['name']}")
    expect(page.get_by_text(f"reads {nearest * 2:g} to {farthest * 2:g} m well")).to_be_visible()
    page.goto(f"#depth/{weak['name']}")
    expect(page.get_by_text("reads no depth well")).to_be_visible()


def test_cameras_fit_a_phone_and_the_dark(
    page: Page, served: Server, d200: dict[str, Any], barriers: Callable[[Page], list[str]]
) -> None:
    page.set_viewport_size({"width": 360, "height": 740})
    page.emulate_media(color_scheme="dark")
    open_camera(page, served, d200)
    expect(page.get_by_role("img", name="Blur against distance")).to_be_visible()
    assert page.evaluate(OVERFLOW) <= 0
    lines, words = ([one.bounding_box() for one in page.locator(f".mark {kind}").all()] for kind in ("line", "text"))
    left, right = sorted(
        (line["x"], word["x"], word["width"]) for line, word in zip(lines, words, strict=True) if line and word
    )
    assert left[1] + left[2] < left[0] < right[0] < right[1]
    assert barriers(page) == []
