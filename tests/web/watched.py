"""A page whose complaints are failures: console errors, uncaught errors, violations of its policy, foreign hosts."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, Request, WebError

# before anything of the page runs: what its policy forbids is said in the console, where it can be read
TELL_VIOLATIONS = """addEventListener("securitypolicyviolation", (event) =>
  console.error(`policy violated: ${event.violatedDirective} ${event.blockedURI}`));"""
OWN_SCHEMES = {"blob", "data"}


@contextmanager
def lasting(browser: Browser, url: str, **options: Any) -> Iterator[BrowserContext]:
    """A context for many pages: what the one that stays open has loaded and compiled, the others need not."""
    context = browser.new_context(base_url=url, **options)
    try:
        context.add_init_script(TELL_VIOLATIONS)
        context.new_page().goto("web/icon.svg")
        yield context
    finally:
        context.close()


@contextmanager
def watched(browser: Browser, url: str, expected: list[str], **options: Any) -> Iterator[Page]:
    """A page in a new context; at the end, an error that no word of ``expected`` is part of fails."""
    context = browser.new_context(base_url=url, **options)
    try:
        context.add_init_script(TELL_VIOLATIONS)
        with watched_in(context, url, expected) as page:
            yield page
    finally:
        context.close()


@contextmanager
def watched_in(context: BrowserContext, url: str, expected: list[str]) -> Iterator[Page]:
    """A page in a context that goes on; it, pages that it opened, and what it was permitted are gone afterwards."""
    complaints: list[str] = []
    before = context.pages  # of which one that is a picture asks for an icon

    def note_message(message: ConsoleMessage) -> None:
        if message.type == "error" and message.page not in before:
            complaints.append(f"{message.text} ({message.location.get('url', '')})")

    def note_error(caught: WebError) -> None:
        complaints.append(f"uncaught: {caught.error}")

    def note_request(request: Request) -> None:
        parts = urlsplit(request.url)
        if parts.scheme not in OWN_SCHEMES and parts.netloc != urlsplit(url).netloc:
            complaints.append(f"request to another host: {request.url}")

    context.on("console", note_message)
    context.on("weberror", note_error)
    context.on("request", note_request)
    try:
        yield context.new_page()
    finally:
        for opened in context.pages:
            if opened not in before:
                opened.close()
        context.set_offline(False)
        context.clear_permissions()
        context.remove_listener("console", note_message)
        context.remove_listener("weberror", note_error)
        context.remove_listener("request", note_request)
    unexpected = [text for text in complaints if not any(word in text for word in expected)]
    assert not unexpected, "\n".join(unexpected)
