"""One photograph out of a request: the raw body, or a multipart field.

How large a body may be is for ``LimitRequests``, in front of every route, to say.
"""

import sys
from collections import Counter
from collections.abc import AsyncGenerator, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from fastapi import Request
from starlette.datastructures import UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser

from service.errors import BadRequest, Busy
from service.inference.images import PHOTOGRAPH_TYPES, declared_kind
from service.principal import Principal

FIELD = "image"
MULTIPART = "multipart/form-data"
BINARY = {"type": "string", "format": "binary"}
# what a route that takes a photograph says of its body
REQUEST_BODY = {
    "required": True,
    "description": f"The photograph itself, or a form with it in the field `{FIELD}`",
    "content": {
        # the form first: of the types beside it some clients know nothing, and others make no working code
        MULTIPART: {
            "schema": {
                "type": "object",
                "required": [FIELD],
                "additionalProperties": False,
                "properties": {FIELD: BINARY},
            },
            "encoding": {FIELD: {"contentType": ", ".join(PHOTOGRAPH_TYPES)}},
        },
        **{name: {"schema": BINARY} for name in PHOTOGRAPH_TYPES},
    },
}


@dataclass(frozen=True, slots=True)
class Upload:
    """The bytes of a photograph and the media type they were declared as."""

    data: bytes
    media_type: str | None


class Arrivals:
    """Photographs that have arrived in part: their bytes, over all requests, are bounded and shared, as the queue is.

    For the event loop alone.
    """

    def __init__(self, most_bytes: int) -> None:
        self._most_bytes = most_bytes
        self._held_bytes: Counter[str | None] = Counter()

    @contextmanager
    def counted(self, sharer: str | None = None) -> Iterator[Callable[[int], None]]:
        """Gives a function that counts some more bytes, or raises ``Busy``; all are given back at the end."""
        taken_bytes = 0

        def take(count: int) -> None:
            nonlocal taken_bytes
            own_bytes = self._held_bytes[sharer] if sharer is not None else 0
            if self._held_bytes.total() + own_bytes + count > self._most_bytes:
                raise Busy("Too many photographs arrive at once: try again later.")
            self._held_bytes[sharer] += count
            taken_bytes += count

        try:
            yield take
        finally:
            self._held_bytes[sharer] -= taken_bytes


async def receive_photograph(request: Request) -> Upload:
    """The photograph of a request.

    Raises ``UnsupportedKind`` (a declared type that is not listed), ``BadRequest`` (a form without the field, or with
    others) and ``Busy`` (too much arrives at once).
    """
    media_type = request.headers.get("content-type")
    arrivals: Arrivals = request.app.state.arrivals
    principal: Principal = request.state.principal
    with arrivals.counted(principal.sharer) as take:
        if media_type is not None and media_type.lower().startswith(MULTIPART):
            return await _from_form(request, take)
        declared_kind(media_type)
        chunks = [chunk async for chunk in _taken(request, take)]
        return Upload(b"".join(chunks), media_type)


async def _from_form(request: Request, take: Callable[[int], None]) -> Upload:
    parser = MultiPartParser(request.headers, _taken(request, take), max_files=1, max_fields=1)
    # photographs for depth are never written to a disk, not even to an unnamed file
    parser.spool_max_size = sys.maxsize
    try:
        form = await parser.parse()
    except (MultiPartException, ValueError) as exc:  # ValueError: of a charset that decodes nothing
        detail = f"The form cannot be read ({exc}): send one file, with a file name, in the field '{FIELD}'."
        raise BadRequest.at(detail, f"#/{FIELD}") from exc
    try:
        file = form.get(FIELD)
        if not isinstance(file, UploadFile) or len(form.multi_items()) != 1:
            detail = f"Send one file, with a file name, in the field '{FIELD}', and no other field."
            raise BadRequest.at(detail, f"#/{FIELD}")
        declared_kind(file.content_type)
        return Upload(await file.read(), file.content_type)
    finally:
        await form.close()


async def _taken(request: Request, take: Callable[[int], None]) -> AsyncGenerator[bytes, None]:
    """The body in chunks, each counted."""
    async for chunk in request.stream():
        take(len(chunk))
        yield chunk
