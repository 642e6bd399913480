"""The page's frame in a real browser: tabs, keyboard, API key, accessibility, and a service that goes away."""

import json
import re
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from playwright.sync_api import Browser, BrowserContext, FilePayload, Page, expect

from model_export.started_server import Server, serving
from service.config import DATABASE_FILE
from service.principal import EVERYDAY, SCOPES, Scope
from service.storage import schema
from service.storage.engine import open_engine
from service.storage.keys import Keys
from tests.inference.photographs import png
from tests.web.steps import OVERFLOW, to_photographs
from tests.web.watched import lasting, watched, watched_in

ROOT = Path(__file__).parents[2]
TABS = ("depth", "cameras", "calibrate", "status")
QUOTA = 40
REFUSED = "status of 401"
NO_STORAGE = """Object.defineProperty(window, "sessionStorage", {
  get() { throw new DOMException("The operation is insecure.", "SecurityError"); },
});"""
LINE_COLOUR = "(element) => getComputedStyle(element).borderBottomColor"
NARROWEST = """() => Math.min(...[...document.querySelectorAll(".facts dd")]
  .filter((one) => one.checkVisibility()).map((one) => one.clientWidth))"""


@dataclass(frozen=True)
class Keyed:
    """A service that wants keys, and a way to make them."""

    server: Server
    keys: Keys
    context: BrowserContext

    def page(self, expected: list[str]) -> AbstractContextManager[Page]:
        """A page that knows no key: it is kept for a tab."""
        return watched_in(self.context, self.server.url, expected)

    def key(self, *scopes: Scope) -> str:
        return self.keys.create("page", "page", scopes or EVERYDAY)[1]


@pytest.fixture(scope="module")
def keyed(browser: Browser, tmp_path_factory: pytest.TempPathFactory, tiny_model_dir: Path) -> Iterator[Keyed]:
    data_dir = tmp_path_factory.mktemp("keyed") / "data"
    data_dir.mkdir()
    engine = open_engine(f"sqlite:///{data_dir / DATABASE_FILE}")
    schema.upgrade(engine)
    keys = Keys(engine)
    keys.create("first", "nobody")
    wanted = {"CAMIND_API_KEYS": "on", "CAMIND_KEY_REQUESTS_PER_MINUTE": str(QUOTA)}
    with (
        serving(data_dir, "--model", tiny_model_dir, settings=wanted) as server,
        lasting(browser, server.url) as context,
    ):
        yield Keyed(server, keys, context)
    engine.dispose()


def selected(page: Page, name: str) -> None:
    expect(page.get_by_role("tab", name=name)).to_have_attribute("aria-selected", "true")
    expect(page.get_by_role("tabpanel")).to_have_count(1)
    expect(page.get_by_role("tabpanel", name=name)).to_be_visible()


def give_key(page: Page, key: str) -> None:
    page.get_by_label("Key", exact=True).fill(key)
    page.get_by_role("button", name="Use this key").click()


def test_the_page_opens_on_the_depth_view(page: Page) -> None:
    page.goto("")
    selected(page, "Depth")


def test_a_page_that_came_in_part_says_so(page: Page, expected_errors: list[str]) -> None:
    expected_errors.append("net::ERR_")
    page.route("**/web/ticks.js", lambda route: route.abort())
    page.goto("")
    expect(page.get_by_text("If this stays, load the page again.")).to_be_visible()
    page.unroute("**/web/ticks.js")
    page.reload()
    selected(page, "Depth")
    expect(page.get_by_text("If this stays")).to_have_count(0)


def test_tabs_are_addresses(page: Page) -> None:
    page.goto("#cameras")
    selected(page, "Cameras")
    page.get_by_role("tab", name="Status").click()
    assert page.url.endswith("#status")
    selected(page, "Status")
    expect(page).to_have_title("Status · camind")
    page.go_back()
    selected(page, "Cameras")
    expect(page).to_have_title("Cameras · camind")
    page.goto("#cameras/two%20words")
    expect(page).to_have_title("two words · Cameras · camind")
    page.goto("#nowhere/%ff")
    selected(page, "Depth")


def test_tabs_work_from_the_keyboard_and_show_where_it_is(page: Page) -> None:
    page.goto("")
    page.keyboard.press("Tab")
    page.keyboard.press("Tab")
    for key, name in (
        ("ArrowRight", "Cameras"),
        ("End", "Status"),
        ("ArrowRight", "Depth"),
        ("ArrowLeft", "Status"),
        ("Home", "Depth"),
    ):
        page.keyboard.press(key)
        selected(page, name)
        tab = page.get_by_role("tab", name=name)
        expect(tab).to_be_focused()
        outline = tab.evaluate("(element) => getComputedStyle(element).outline")
        assert re.search(r"solid 2px|2px solid", outline), outline
    # one stop for all tabs, then on into the view
    page.keyboard.press("Tab")
    expect(page.get_by_role("tab", name="Depth")).not_to_be_focused()


def test_the_chosen_tab_differs_in_the_readers_own_colours(page: Page) -> None:
    page.emulate_media(forced_colors="active")
    page.goto("#status")
    tabs = page.get_by_role("tab").all()
    colours = {tab.get_attribute("aria-selected"): tab.evaluate(LINE_COLOUR) for tab in tabs}
    assert colours["true"] != colours["false"]


@pytest.mark.parametrize("tab", TABS)
def test_nothing_keeps_people_out(page: Page, barriers: Callable[[Page], list[str]], tab: str) -> None:
    page.goto(f"#{tab}")
    page.wait_for_load_state("networkidle")
    schemes: tuple[Literal["light", "dark"], ...] = ("light", "dark")
    for scheme in schemes:
        page.emulate_media(color_scheme=scheme)
        assert barriers(page) == [], scheme
    page.set_viewport_size({"width": 360, "height": 640})
    assert page.evaluate(OVERFLOW) <= 0
    page.context.new_cdp_session(page).send("Page.setFontSizes", {"fontSizes": {"standard": 32}})
    expect(page.locator("html")).to_have_css("font-size", "30px")
    assert page.evaluate(OVERFLOW) <= 0
    fields = page.locator(".field > :is(input, select)").filter(visible=True).all()
    assert all(field.evaluate("(one) => getComputedStyle(one).fontSize") == "30px" for field in fields)
    assert page.evaluate(NARROWEST) > 150


def test_status_tells_what_the_service_tells(page: Page, served: Server) -> None:
    manifest = served.ask("GET", "/model").json()["manifest"]
    page.goto("#status")
    expect(page.get_by_text("Ready", exact=True)).to_be_visible()
    expect(page.get_by_role("status")).to_contain_text("The service is ready.")
    row = page.get_by_role("row", name="plane 1 m")
    expect(row.get_by_role("cell").first).to_have_text(f"{manifest['scores']['plane 1 m.abs_rel']:.3f}")
    expect(page.get_by_role("region", name="Queue")).to_contain_text("0 of 16 waiting")
    before = page.get_by_role("region", name="Latency").inner_text()
    served.add({"name": "status", "image_width_px": 600, "image_height_px": 400, "focus_distance_m": 1, "k_cam_px": 4})
    photograph = (ROOT / "docs" / "pictures" / "coffee.jpg").read_bytes()
    assert served.ask("POST", "/depth?camera=status", photograph, {"Content-Type": "image/jpeg"}).status == 200
    # it looks again by itself
    expect(page.get_by_role("region", name="Latency")).not_to_have_text(before)
    expect(page.get_by_role("row", name="Depth graph")).to_be_visible()
    served.ask("DELETE", "/cameras/status")


def test_a_key_is_asked_for_once_and_kept_for_the_tab(keyed: Keyed) -> None:
    with keyed.page([REFUSED]) as page:
        page.goto("#cameras")
        dialog = page.get_by_role("dialog", name="API key")
        expect(dialog).to_be_visible()
        expect(page.get_by_label("Key", exact=True)).to_be_focused()
        give_key(page, "no key")
        expect(dialog).to_contain_text("This is no API key")
        give_key(page, f"camind_0123456789ab_{'x' * 43}")
        expect(dialog).to_contain_text("unknown, revoked or expired")
        give_key(page, keyed.key())
        expect(dialog).to_be_hidden()
        expect(page.get_by_role("alert").filter(visible=True)).to_have_count(0)
        with page.expect_response(lambda answer: "/cameras?" in answer.url) as answered:
            page.reload()
        assert answered.value.status == 200
        expect(dialog).to_be_hidden()
        assert page.evaluate("localStorage.length + document.cookie.length") == 0
        another = page.context.new_page()
        another.goto(keyed.server.url)
        expect(another.get_by_role("dialog", name="API key")).to_be_visible()
        page.get_by_role("button", name="Forget API key").click()
        expect(dialog).to_be_visible()


def test_a_browser_that_stores_nothing_holds_the_key_until_the_page_is_left(keyed: Keyed) -> None:
    with keyed.page([REFUSED]) as page:
        page.add_init_script(NO_STORAGE)
        page.goto("#cameras")
        give_key(page, keyed.key())
        expect(page.get_by_role("button", name="Forget API key")).to_be_visible()
        expect(page.get_by_text("There is no camera yet.")).to_be_visible()


def test_without_a_key_the_page_says_what_it_lacks(keyed: Keyed, barriers: Callable[[Page], list[str]]) -> None:
    with keyed.page([REFUSED]) as page:
        page.goto("")
        expect(page.get_by_role("dialog", name="API key")).to_be_visible()
        assert barriers(page) == []
        page.keyboard.press("Escape")
        expect(page.get_by_role("dialog", name="API key")).to_be_hidden()
        expect(page.get_by_role("alert").filter(has_text="API key needed")).to_be_visible()
        assert barriers(page) == []
        page.get_by_role("button", name="Try again").first.click()
        give_key(page, keyed.key())
        expect(page.get_by_role("alert").filter(visible=True)).to_have_count(0)


def test_another_owners_key_brings_its_own_cameras(keyed: Keyed, d200: dict[str, Any]) -> None:
    known, key = keyed.keys.create("guest", "guest", EVERYDAY)
    headers = {"Authorization": f"Bearer {key}", "Content-Type": "application/json"}
    assert keyed.server.ask("POST", "/cameras", json.dumps({**d200, "name": "theirs"}), headers).status == 201
    with keyed.page([REFUSED, "status of 404"]) as page:
        page.goto("#cameras/theirs")
        give_key(page, key)
        theirs = page.get_by_role("button", name="theirs")
        expect(theirs).to_be_visible()
        expect(page.get_by_role("img", name="Blur against distance")).to_be_visible()
        keyed.keys.revoke(known.id)
        page.get_by_text("Revisions").click()
        give_key(page, keyed.key())
        expect(theirs).to_have_count(0)


def test_photographs_of_the_sheet_ask_once_for_a_key_that_nobody_gives(keyed: Keyed) -> None:
    with keyed.page([REFUSED]) as page:
        page.goto("")
        dialog = page.get_by_role("dialog", name="API key")
        expect(dialog).to_be_visible()
        page.keyboard.press("Escape")
        to_photographs(page, "bench")
        grey = png(np.full((480, 640, 3), 120, np.uint8))
        of_nothing = [FilePayload(name=f"{place}.png", mimeType="image/png", buffer=grey) for place in range(3)]
        page.locator("input[data-role=defocused]").set_input_files(of_nothing)
        expect(dialog).to_be_visible()
        page.keyboard.press("Escape")
        expect(page.get_by_text("not looked at", exact=True)).to_have_count(3)
        expect(dialog).to_be_hidden()
        page.get_by_role("button", name="Look again").last.click()
        give_key(page, keyed.key())
        expect(page.get_by_text("no grid", exact=True)).to_have_count(3)


@pytest.mark.parametrize(("scopes", "seen"), [(EVERYDAY, "scope admin"), (SCOPES, "waiting")])
def test_status_shows_what_the_key_may_see(keyed: Keyed, scopes: tuple[Scope, ...], seen: str) -> None:
    with keyed.page([REFUSED, "status of 403"]) as page:
        page.goto("")
        give_key(page, keyed.key(*scopes))
        page.get_by_role("tab", name="Status").click()
        expect(page.get_by_role("region", name="Queue")).to_contain_text(seen)
        with page.expect_download() as saved:
            page.get_by_role("button", name="Download the API as OpenAPI").click()
        assert '"openapi"' in saved.value.path().read_text()


def test_who_may_not_list_cameras_reads_by_the_one_that_a_link_names(keyed: Keyed, d200: dict[str, Any]) -> None:
    headers = {"Authorization": f"Bearer {keyed.key()}", "Content-Type": "application/json"}
    assert keyed.server.ask("POST", "/cameras", json.dumps(d200), headers).status == 201
    with keyed.page([REFUSED, "status of 403"]) as page:
        page.goto("#cameras")
        give_key(page, keyed.key("depth"))
        expect(page.get_by_text("The list did not come.")).to_be_visible()
        expect(page.get_by_text("Loading")).to_have_count(0)
        expect(page.locator(".depth-camera option:checked")).to_have_text("The list did not come")
        page.goto(f"#depth/{d200['name']}")
        with page.expect_file_chooser() as chooser:
            page.get_by_role("button", name="Choose a photograph").click()
        with page.expect_response(lambda answer: "/depth?" in answer.url) as answered:
            chooser.value.set_files(ROOT / "docs" / "pictures" / "coffee.jpg")
        assert answered.value.status == 200
        expect(page.get_by_role("application", name="Depth of the photograph")).to_be_visible()
        expect(page.get_by_role("alert")).to_have_count(1)  # of the list alone
    keyed.server.ask("DELETE", f"/cameras/{d200['name']}", headers=headers)


def test_a_quota_says_when_to_come_back(keyed: Keyed) -> None:
    key = keyed.key()
    for _ in range(QUOTA):
        keyed.server.ask("GET", "/model", headers={"Authorization": f"Bearer {key}"})
    with keyed.page([REFUSED, "status of 429"]) as page:
        page.goto("")
        give_key(page, key)
        problem = page.get_by_role("alert").filter(has_text="Quota exceeded").first
        expect(problem).to_contain_text(re.compile(r"Try again \(in \d+ s\)"))
        expect(problem).to_contain_text("Request ")


def test_a_service_that_stops_is_told_apart_from_one_that_refuses_and_from_one_with_another_model(
    browser: Browser, tmp_path: Path, tiny_model_dir: Path, d200: dict[str, Any]
) -> None:
    with (
        serving(tmp_path / "data", "--model", tiny_model_dir) as server,
        watched(browser, server.url, ["ERR_CONNECTION_REFUSED", "status of 503"]) as page,
    ):
        server.add(d200)
        page.goto("#depth/d200")
        with page.expect_file_chooser() as chooser:
            page.get_by_role("button", name="Choose a photograph").click()
        chooser.value.set_files(ROOT / "docs" / "pictures" / "coffee.jpg")
        expect(page.get_by_role("application", name="Depth of the photograph")).to_be_visible()
        page.get_by_role("tab", name="Status").click()
        expect(page.get_by_text("Ready", exact=True)).to_be_visible()
        server.stop(signal.SIGTERM)
        expect(page.get_by_text("No answer", exact=True)).to_be_visible(timeout=20_000)
        expect(page.get_by_role("alert").filter(visible=True)).to_contain_text("The service does not answer.")
        expect(page.get_by_role("status")).to_contain_text("The service is not ready.")
        with serving(tmp_path / "data", "--port", str(server.port)) as newer:
            model = newer.ask("GET", "/model").json()["manifest"]["name"]
            expect(page.get_by_role("region", name="Model").locator(".badge")).to_have_text(model)
            page.get_by_role("tab", name="Depth").click()
            downloads: list[str] = []
            page.on("download", lambda download: downloads.append(download.suggested_filename))
            with page.expect_response(lambda answer: "format=npz" in answer.url):
                page.get_by_role("button", name="Download").click()
            told = page.get_by_text(f"The model is {model} now: nothing is downloaded, the photograph is read again")
            expect(told).to_be_visible()
            expect(page.locator("details").filter(has_text="The service took")).to_contain_text(model)
            assert downloads == []


def test_the_api_module_tells_problems_apart(page: Page, expected_errors: list[str]) -> None:
    expected_errors.append("status of 422")
    page.goto("")
    told = page.evaluate(
        """async () => {
          const { Problem, getJson, upload } = await import("/web/api.js");
          const headers = { "Content-Type": "application/json" };
          const fractions = [];
          const body = JSON.stringify({ name: "a", nonsense: "x".repeat(15000) });
          const onProgress = (fraction) => fractions.push(fraction);
          const refused = await upload("cameras", { headers, body, onProgress }).catch((error) => error);
          const stop = new AbortController();
          const aborted = getJson("model", { signal: stop.signal }).catch((error) => error.name);
          stop.abort();
          const isProblem = refused instanceof Problem;
          return { ...refused, isProblem, fractions, aborted: await aborted };
        }"""
    )
    assert told["isProblem"]
    assert (told["status"], told["title"]) == (422, "Invalid request")
    assert {"#/nonsense", "#/image_width_px"} <= {fault["pointer"] for fault in told["errors"]}
    assert told["requestId"]
    assert told["fractions"][-1] == 1
    assert told["aborted"] == "AbortError"
