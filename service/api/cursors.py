"""Pages of lists: their cursors are opaque to clients, and checked when they come back."""

import re
from base64 import urlsafe_b64decode, urlsafe_b64encode
from typing import Annotated

from fastapi import Query
from pydantic import Field

from service.errors import BadRequest
from service.storage.cameras import NAME_PATTERN

PREFIX = "after:"

Limit = Annotated[int, Query(ge=1, le=200)]
Cursor = Annotated[str | None, Query(max_length=200, description="`next_cursor` of the page before")]
NextCursor = Annotated[str | None, Field(description="Pass it as `cursor` for the next page; null: the last")]


def cursor_after(last: str | int) -> str:
    """A cursor for what comes behind the last name, id or number."""
    return urlsafe_b64encode(f"{PREFIX}{last}".encode()).decode().rstrip("=")


def name_of(cursor: str | None, pattern: str = NAME_PATTERN) -> str | None:
    """The name or id in a cursor, ``None`` for none. Raises ``BadRequest`` for a cursor that never was one."""
    if cursor is None:
        return None
    try:
        text = urlsafe_b64decode(cursor + "==").decode()
    except ValueError:
        text = ""
    name = text.removeprefix(PREFIX)
    if not text.startswith(PREFIX) or not re.fullmatch(pattern, name):
        detail = "This cursor is not valid here: take next_cursor from the previous page, or leave it out."
        raise BadRequest.at(detail, "cursor")
    return name
