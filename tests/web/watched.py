"""A page whose complaints are failures: console errors, uncaught errors, violations of its policy, foreign hosts."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from playwright.sync_api import Browser, ConsoleMessage, Error, Page, Request

# before anything of the page runs: what its policy forbids is said in the console, where it can be read
TELL_VIOLATIONS = """addEventListener("securitypolicyviolation", (event) =>
  console.error(`policy violated: ${event.violatedDirective} ${event.blockedURI}`));"""
OWN_SCHEMES = {"blob", "data"}


@contextmanager
def watched(browser: Browser, url: str, expected: list[str], **options: Any) -> Iterator[Page]:
    """A page in a new context; at the end, an error that no word of ``expected`` is part of fails."""
    complaints: list[str] = []

    def note_message(message: ConsoleMessage) -> None:
        if message.type == "error":
            complaints.append(f"{message.text} ({message.location.get('url', '')})")

    def note_error(error: Error) -> None:
        complaints.append(f"uncaught: {error}")

    def note_request(request: Request) -> None:
        parts = urlsplit(request.url)
        if parts.scheme not in OWN_SCHEMES and parts.netloc != urlsplit(url).netloc:
            complaints.append(f"request to another host: {request.url}")

    context = browser.new_context(base_url=url, **options)
    try:
        context.add_init_script(TELL_VIOLATIONS)
        context.on("console", note_message)
        context.on("weberror", lambda caught: note_error(caught.error))
        context.on("request", note_request)
        yield context.new_page()
    finally:
        context.close()
    unexpected = [text for text in complaints if not any(word in text for word in expected)]
    assert not unexpected, "\n".join(unexpected)
