"""The system's Chromium, driven by Playwright."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager

from playwright.sync_api import Browser, sync_playwright

PROGRAMS = ("chromium", "chromium-browser", "google-chrome")
# WebGL without a graphics card; and the sandbox wants rights that a container's root has not
ARGUMENTS = ["--no-sandbox", "--enable-unsafe-swiftshader"]


def program() -> str:
    """The path of the browser. Raises ``FileNotFoundError`` where none is installed."""
    found = next(filter(None, map(shutil.which, PROGRAMS)), None)
    if found is None:
        raise FileNotFoundError("the page is opened in a browser: install Debian's package chromium (`make chromium`)")
    return found


@contextmanager
def running_browser() -> Iterator[Browser]:
    """A browser for a while. Raises ``FileNotFoundError`` where none is installed."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program(), args=ARGUMENTS)
        yield browser
        browser.close()
