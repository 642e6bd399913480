"""A real browser at a real service: the system's Chromium, the shipped model, and a page that may not complain."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, BrowserContext, Page, expect

from model_export.started_server import Server, serving
from tests.web.chromium import running_browser
from tests.web.watched import lasting, watched_in

AXE = Path(__file__).parents[2] / "node_modules" / "axe-core" / "axe.min.js"
PATIENCE_MS = 20_000  # on a machine that has other work


@pytest.fixture(scope="session")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A service with the shipped model and no camera yet; ``served.url`` is its page."""
    with serving(tmp_path_factory.mktemp("page") / "data") as server:
        yield server


# a module's, for Playwright keeps an event loop running in this thread, where other tests may want their own
@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """The system's Chromium; fails where there is none."""
    expect.set_options(timeout=PATIENCE_MS)
    with running_browser() as browser:
        yield browser


@pytest.fixture
def expected_errors() -> list[str]:
    """Parts of messages that a test says its page will log; anything else fails it."""
    return []


@pytest.fixture(scope="module")
def context(browser: Browser, served: Server) -> Iterator[BrowserContext]:
    """A module's: half of what it costs to open a page is its context. A tab has its own storage; there is no other."""
    with lasting(browser, served.url) as context:
        yield context


@pytest.fixture
def page(context: BrowserContext, served: Server, expected_errors: list[str]) -> Iterator[Page]:
    """A page of its own, whose addresses are relative to the service; it fails on complaints."""
    with watched_in(context, served.url, expected_errors) as opened:
        yield opened


@pytest.fixture(scope="session")
def barriers() -> Callable[[Page], list[str]]:
    """What keeps people out of a page as it stands, by axe: its serious and critical findings."""
    if not AXE.exists():
        pytest.fail("these tests ask axe about accessibility: `make setup` brings it")
    axe = AXE.read_text(encoding="utf-8")

    def find(page: Page) -> list[str]:
        page.evaluate(axe)
        found = page.evaluate("async () => (await axe.run({resultTypes: ['violations']})).violations")
        grave = [rule for rule in found if rule["impact"] in ("serious", "critical")]
        return [f"{rule['id']}: {node['html'][:200]}" for rule in grave for node in rule["nodes"]]

    return find
