"""Whom a request is for, and the scopes of what a key may do."""

from dataclasses import dataclass
from typing import Literal, get_args

Scope = Literal["depth", "cameras:read", "cameras:write", "calibrate", "admin"]
SCOPES: tuple[Scope, ...] = get_args(Scope)
EVERYDAY = SCOPES[:-1]

# the owner of what is made without API keys
LOCAL = "local"


@dataclass(frozen=True, slots=True)
class Principal:
    """The owner of what a request makes and sees, and the key it came with, if any."""

    owner: str
    key_id: str | None = None

    @property
    def sharer(self) -> str | None:
        """The owner, where others may have keys too; None where all is one owner's."""
        return self.owner if self.key_id else None


ANYBODY = Principal(LOCAL)
