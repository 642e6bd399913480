"""Work that is done only as long as somebody waits for it."""

import asyncio
from collections import Counter
from collections.abc import Awaitable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from fastapi import Request
from starlette.requests import ClientDisconnect

from service.errors import Busy

T = TypeVar("T")
MOST_FOLLOWERS = 20


class Followers:
    """Requests that wait for changes, for each of which the database is asked all the time: bounded for each owner.

    For the event loop alone.
    """

    def __init__(self) -> None:
        self._following: Counter[str] = Counter()

    @contextmanager
    def counted(self, owner: str) -> Iterator[None]:
        """Count one request more. Raises ``Busy`` where the owner's other ones are as many as may be."""
        if self._following[owner] >= MOST_FOLLOWERS:
            raise Busy(f"{MOST_FOLLOWERS} requests of this owner wait for changes already: end one of them first.")
        self._following[owner] += 1
        try:
            yield
        finally:
            self._following[owner] -= 1


async def unless_gone(request: Request, work: Awaitable[T]) -> T:
    """The work's result; ``ClientDisconnect`` where the client went away, which cancels the work."""
    running = asyncio.ensure_future(work)
    gone = asyncio.ensure_future(_disconnected(request))
    try:
        await asyncio.wait({running, gone}, return_when=asyncio.FIRST_COMPLETED)
        if not running.done():
            raise ClientDisconnect
        return running.result()
    finally:
        running.cancel()
        gone.cancel()


async def _disconnected(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
