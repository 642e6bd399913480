"""Requests that may be sent again: the same Idempotency-Key from the same owner is the same request, for a day.

What came of the first is noted in the transaction that did it, so that both are there or neither.
"""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from sqlalchemy import delete
from sqlmodel import Session, col

from service.errors import KeyReused
from service.storage.tables import IdempotencyRow

KEPT = timedelta(days=1)


@dataclass(frozen=True, slots=True)
class Once:
    """The client's key, and a hash of everything else in the request."""

    key: str
    fingerprint: str


def once_of(key: str | None, parts: Iterable[bytes]) -> Once | None:
    """A request with this key, made of these parts; None without a key."""
    if key is None:
        return None
    digest = hashlib.sha256()
    for part in parts:
        digest.update(hashlib.sha256(part).digest())
    return Once(key, digest.hexdigest())


def noted(session: Session, owner: str, key: str) -> IdempotencyRow | None:
    """What is remembered of a key; None for a new one."""
    row = session.get(IdempotencyRow, (owner, key))
    return None if row is None or row.created_at < datetime.now(UTC) - KEPT else row


def outcome_of(session: Session, owner: str, once: Once) -> str | None:
    """What came of the request before; None for a new one. Raises ``KeyReused`` where it was another request."""
    row = noted(session, owner, once.key)
    if row is None:
        return None
    if row.fingerprint != once.fingerprint:
        raise KeyReused("This Idempotency-Key came with another request before: send a new key with a new request.")
    return row.outcome


def note(session: Session, owner: str, once: Once, outcome: str) -> None:
    """Note what came of it, and forget what is older than a day."""
    now = datetime.now(UTC)
    session.connection().execute(delete(IdempotencyRow).where(col(IdempotencyRow.created_at) < now - KEPT))
    session.add(
        IdempotencyRow(owner=owner, key=once.key, fingerprint=once.fingerprint, outcome=outcome, created_at=now)
    )
    session.flush()
