"""API keys: shown once when they are made, stored as a hash, and good until they expire or are revoked.

A key acts for an owner, to whom cameras and calibrations belong: a second key for the same owner takes the place of a
lost one.
"""

import hashlib
import hmac
import re
import secrets
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from sqlalchemy import Engine
from sqlmodel import col, select

from service.errors import BadRequest, CamindError, NotFound
from service.principal import EVERYDAY, SCOPES, Scope
from service.storage.cameras import NAME_PATTERN
from service.storage.engine import reading, writing
from service.storage.tables import ApiKeyRow

PREFIX = "camind"
ID_BYTES, SECRET_BYTES = 6, 32
# what the hash of no secret is compared with, so that an unknown key takes as long as a wrong one
NO_DIGEST = "0" * 64
NOTED_EVERY = timedelta(minutes=1)


@dataclass(frozen=True, slots=True)
class ApiKey:
    """A stored key, all but its secret. Times are UTC."""

    id: str
    name: str
    owner: str
    scopes: frozenset[Scope]
    created_at: datetime
    expires_at: datetime | None
    last_used_at: datetime | None
    revoked_at: datetime | None

    def is_good(self, now: datetime) -> bool:
        """Whether it opens anything at all."""
        return self.revoked_at is None and (self.expires_at is None or now < self.expires_at)


class Keys:
    """The API keys of one database; safe to share between threads."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    def create(
        self, name: str, owner: str, scopes: Sequence[Scope] = EVERYDAY, expires_at: datetime | None = None
    ) -> tuple[ApiKey, str]:
        """A new key, and the text a client sends for it, which is nowhere else. Raises ``BadRequest`` for a name."""
        for text in (name, owner):
            if not re.fullmatch(NAME_PATTERN, text):
                raise BadRequest(f"'{text[:80]}' is no name: letters, digits, '.', '_' and '-', 64 at most.")
        secret = secrets.token_urlsafe(SECRET_BYTES)
        row = ApiKeyRow(
            id=secrets.token_hex(ID_BYTES),
            digest=_digest(secret),
            name=name,
            owner=owner,
            scopes=[scope for scope in SCOPES if scope in scopes],
            created_at=datetime.now(UTC),
            expires_at=expires_at,
        )
        with writing(self._engine) as session:
            session.add(row)
            session.flush()
            return _to_key(row), f"{PREFIX}_{row.id}_{secret}"

    def every(self) -> list[ApiKey]:
        """Every key there ever was, the oldest first."""
        with reading(self._engine) as session:
            return [_to_key(row) for row in session.exec(select(ApiKeyRow).order_by(col(ApiKeyRow.created_at)))]

    def has_good(self) -> bool:
        """Whether any key would be let in now."""
        now = datetime.now(UTC)
        return any(key.is_good(now) for key in self.every())

    def revoke(self, key_id: str) -> ApiKey:
        """Let it in no more, from now on. Raises ``NotFound``."""
        with writing(self._engine) as session:
            row = session.get(ApiKeyRow, key_id)
            if row is None:
                raise NotFound(f"There is no key '{key_id[:64]}': `camind keys list` shows them.")
            row.revoked_at = row.revoked_at or datetime.now(UTC)
            return _to_key(row)

    def find(self, text: str) -> ApiKey | None:
        """The key that this text is, where it is good; None for a wrong, an expired and a revoked one alike."""
        key_id, secret = _halves(text)
        digest = _digest(secret)
        with reading(self._engine) as session:
            # the hash alone: a whole row of a wrong key would take longer than none of an unknown one
            stored = session.exec(select(ApiKeyRow.digest).where(col(ApiKeyRow.id) == key_id)).first()
            is_right = hmac.compare_digest(digest, stored or NO_DIGEST)
            row = session.get(ApiKeyRow, key_id) if is_right else None
            key = _to_key(row) if row else None
        now = datetime.now(UTC)
        if key is None or not key.is_good(now):
            return None
        # a use that a clock since set back noted is not the last one
        if key.last_used_at is None or abs(now - key.last_used_at) >= NOTED_EVERY:
            # a database that takes no writes is no reason to refuse a reader
            with suppress(CamindError):
                self._note_use(key.id, now)
        return key

    def is_good(self, key_id: str) -> bool:
        """Whether a key that was let in still would be."""
        with reading(self._engine) as session:
            row = session.get(ApiKeyRow, key_id)
            return row is not None and _to_key(row).is_good(datetime.now(UTC))

    def _note_use(self, key_id: str, now: datetime) -> None:
        with writing(self._engine) as session:
            row = session.get(ApiKeyRow, key_id)
            if row is not None:
                row.last_used_at = now


def _digest(secret: str) -> str:
    # the secret has 256 random bits: there is nothing to guess that a slow hash would protect
    return hashlib.sha256(secret.encode()).hexdigest()


def _halves(text: str) -> tuple[str, str]:
    found = re.fullmatch(rf"{PREFIX}_([0-9a-f]{{{2 * ID_BYTES}}})_([A-Za-z0-9_-]{{43}})", text)
    return (found[1], found[2]) if found else ("", "")


def _to_key(row: ApiKeyRow) -> ApiKey:
    scopes = frozenset(scope for scope in SCOPES if scope in row.scopes)
    return ApiKey(row.id, row.name, row.owner, scopes, row.created_at, row.expires_at, row.last_used_at, row.revoked_at)
