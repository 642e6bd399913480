"""One photograph out of a request: the raw body, or a multipart field; never more bytes than allowed."""

from collections.abc import AsyncGenerator
from dataclasses import dataclass

from fastapi import Request
from starlette.datastructures import UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser

from service.errors import BadRequest, FieldProblem, TooLarge
from service.inference.images import MEDIA_TYPES, declared_kind

FIELD = "image"
MULTIPART = "multipart/form-data"
BINARY = {"type": "string", "format": "binary"}
# what a route that takes a photograph says of its body
REQUEST_BODY = {
    "required": True,
    "description": f"The photograph itself, or a form with it in the field `{FIELD}`",
    "content": {
        **{name: {"schema": BINARY} for name in MEDIA_TYPES},
        MULTIPART: {
            "schema": {
                "type": "object",
                "required": [FIELD],
                "additionalProperties": False,
                "properties": {FIELD: BINARY},
            },
            "encoding": {FIELD: {"contentType": ", ".join(MEDIA_TYPES)}},
        },
    },
}
# boundaries and part headers around the picture
MULTIPART_OVERHEAD_BYTES = 16_384


@dataclass(frozen=True, slots=True)
class Upload:
    """The bytes of a photograph and the media type they were declared as."""

    data: bytes
    media_type: str | None


async def receive_photograph(request: Request, max_bytes: int) -> Upload:
    """The photograph of a request.

    Raises ``TooLarge``, ``UnsupportedKind`` (a declared type that is not listed) and ``BadRequest`` (a form
    without the field, or with others).
    """
    media_type = request.headers.get("content-type")
    if media_type is not None and media_type.lower().startswith(MULTIPART):
        return await _from_form(request, max_bytes)
    declared_kind(media_type)
    chunks = [chunk async for chunk in _bounded(request, max_bytes)]
    return Upload(b"".join(chunks), media_type)


async def _from_form(request: Request, max_bytes: int) -> Upload:
    stream = _bounded(request, max_bytes + MULTIPART_OVERHEAD_BYTES)
    parser = MultiPartParser(request.headers, stream, max_files=1, max_fields=1)
    # photographs for depth are never written to a disk, not even to an unnamed file
    parser.spool_max_size = max_bytes + MULTIPART_OVERHEAD_BYTES
    try:
        form = await parser.parse()
    except (MultiPartException, KeyError, ValueError) as exc:  # ValueError: of a charset that decodes nothing
        raise BadRequest(f"The form cannot be read ({exc}): send one file in the field '{FIELD}'.") from exc
    try:
        file = form.get(FIELD)
        if not isinstance(file, UploadFile) or len(form.multi_items()) != 1:
            detail = f"Send one file in the field '{FIELD}', and no other field."
            raise BadRequest(detail, errors=(FieldProblem(f"#/{FIELD}", detail),))
        declared_kind(file.content_type)
        return Upload(await file.read(), file.content_type)
    finally:
        await form.close()


async def _bounded(request: Request, max_bytes: int) -> AsyncGenerator[bytes, None]:
    """The body in chunks; ``TooLarge`` by its stated length before the first, by its true length after."""
    stated = request.headers.get("content-length", "")
    if stated.isdecimal() and int(stated) > max_bytes:
        raise _too_large(max_bytes)
    received = 0
    async for chunk in request.stream():
        received += len(chunk)
        if received > max_bytes:
            raise _too_large(max_bytes)
        yield chunk


def _too_large(max_bytes: int) -> TooLarge:
    return TooLarge(f"The request body may have at most {max_bytes} bytes.")
