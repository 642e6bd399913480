"""Calibrations in the database: a queue, what each has come to, and the only doors from one state to the next.

``queued -> running -> succeeded | failed | cancelled``; running goes back to queued where the service stops, and what
has ended never changes again, but for the camera that it is accepted into. Each belongs to the spool, the folder of
photographs, of one data folder.
"""

import re
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields
from datetime import UTC, datetime, timedelta
from typing import Literal

from pydantic import JsonValue, TypeAdapter
from sqlalchemy import Engine, delete, func, update
from sqlalchemy.orm import aliased
from sqlmodel import Session, col, select
from sqlmodel.sql.expression import SelectOfScalar

from service.errors import Conflict, NotFound
from service.optics.camera import Camera
from service.principal import LOCAL
from service.storage.cameras import store_calibrated
from service.storage.engine import again_if_beaten, reading, writing
from service.storage.idempotency import Once, note, noted, outcome_of
from service.storage.tables import CalibrationRow

State = Literal["queued", "running", "succeeded", "failed", "cancelled"]
EndState = Literal["succeeded", "failed", "cancelled"]
STATE: TypeAdapter[State] = TypeAdapter(State)
LIVE: tuple[State, ...] = ("queued", "running")

ID_PATTERN = r"^[0-9a-f]{32}$"
ABANDONED_AFTER = timedelta(days=1)
FORGOTTEN_AT_A_TIME = 50
FORGETTING_PAUSE_S = 0.2  # who waits for SQLite's lock looks every 0.1 s


@dataclass(frozen=True, slots=True)
class StoredPicture:
    """A photograph in the spool: what the user calls it, and whether it is of the grid in focus."""

    name: str
    role: str


@dataclass(frozen=True, slots=True)
class CalibrationDraft:
    """A calibration to be: the camera it is for, its settings as sent, and its photographs in their order."""

    id: str
    spool: str
    camera: str
    settings: JsonValue
    pictures: tuple[StoredPicture, ...]


@dataclass(frozen=True, slots=True)
class CalibrationRecord:
    """A stored calibration; ``version`` grows with every change. Times are UTC."""

    draft: CalibrationDraft
    state: State
    progress: float
    images: JsonValue
    result: JsonValue
    problem: str | None
    camera_revision: int | None
    attempts: int
    version: int
    created_at: datetime
    updated_at: datetime

    @property
    def id(self) -> str:
        return self.draft.id

    @property
    def camera(self) -> str:
        return self.draft.camera

    @property
    def settings(self) -> JsonValue:
        return self.draft.settings

    @property
    def has_ended(self) -> bool:
        return self.state not in LIVE


@dataclass(frozen=True, slots=True)
class CalibrationSummary:
    """What a list shows of a calibration: all but what can be long."""

    id: str
    camera: str
    state: State
    progress: float
    problem: str | None
    camera_revision: int | None
    created_at: datetime
    updated_at: datetime


@dataclass(frozen=True, slots=True)
class Ending:
    """What a calibration ends with; ``camera`` is stored under the calibration's camera name, if there is one."""

    state: EndState
    images: JsonValue = None
    result: JsonValue = None
    problem: str | None = None
    camera: Camera | None = None


class Calibrations:
    """The calibrations of one database, or one owner's; safe to share between threads.

    What a client asks is asked of one owner's; another owner's are as if not there.
    """

    def __init__(self, engine: Engine, owner: str | None = None) -> None:
        self._engine = engine
        self._owner = owner

    def add(self, draft: CalibrationDraft, once: Once | None = None) -> CalibrationRecord:
        """Queue a calibration; with ``once``, the one that the same request queued before.

        Raises ``KeyReused`` where ``once`` came with another request.
        """
        return again_if_beaten(self._add, draft, once)

    def has_done(self, key: str) -> bool:
        """Whether a request with this Idempotency-Key was done before."""
        with reading(self._engine) as session:
            return noted(session, self._owner or LOCAL, key) is not None

    def get(self, calibration_id: str) -> CalibrationRecord:
        """The calibration as it is now. Raises ``NotFound``."""
        with reading(self._engine) as session:
            return _to_record(_require_row(session, calibration_id, self._owner))

    def version(self, calibration_id: str) -> int:
        """A number that grows with every change, far cheaper to read than the whole; 0 for one that is not there."""
        with reading(self._engine) as session:
            query = select(CalibrationRow.version).where(col(CalibrationRow.id) == calibration_id)
            return session.exec(query).first() or 0

    def page(self, limit: int, after: str | None = None) -> tuple[list[CalibrationSummary], bool]:
        """Up to ``limit`` calibrations, the newest first, from the one behind ``after``; and whether there are more."""
        columns = [getattr(CalibrationRow, field.name) for field in fields(CalibrationSummary)]
        query = select(*columns).order_by(col(CalibrationRow.number).desc()).limit(limit + 1)
        if self._owner is not None:
            query = query.where(col(CalibrationRow.owner) == self._owner)
        if after is not None:
            mark = select(CalibrationRow.number).where(col(CalibrationRow.id) == after).scalar_subquery()
            query = query.where(col(CalibrationRow.number) < mark)
        with reading(self._engine) as session:
            summaries = [CalibrationSummary(*row) for row in session.exec(query)]
        return summaries[:limit], len(summaries) > limit

    def waiting(self, spool: str) -> Counter[str]:
        """How many of a spool's calibrations are queued, by owner."""
        owner = col(CalibrationRow.owner)
        query = select(owner, func.count()).where(
            col(CalibrationRow.spool) == spool, col(CalibrationRow.state) == "queued"
        )
        with reading(self._engine) as session:
            return Counter(dict(session.exec(query.group_by(owner)).all()))

    def live_counts(self, spool: str) -> dict[State, int]:
        """How many of a spool's calibrations are queued, and how many running."""
        states = col(CalibrationRow.state)
        query = select(states, func.count()).where(col(CalibrationRow.spool) == spool, states.in_(LIVE))
        with reading(self._engine) as session:
            counts = dict(session.exec(query.group_by(states)).all())
        return {state: counts.get(state, 0) for state in LIVE}

    def live(self, ids: Sequence[str]) -> set[str]:
        """Those of the ids that are queued or running."""
        query = select(CalibrationRow.id).where(col(CalibrationRow.id).in_(ids), col(CalibrationRow.state).in_(LIVE))
        with reading(self._engine) as session:
            return set(session.exec(query))

    def take(self, spool: str) -> CalibrationRecord | None:
        """The spool's next in line, now running: the first of the owner who was served longest ago.

        None where nothing waits, which costs no lock.
        """
        if not self.waiting(spool):
            return None
        other = aliased(CalibrationRow)
        served_at = (
            select(func.max(other.updated_at))
            .where(col(other.spool) == spool, col(other.owner) == CalibrationRow.owner, col(other.state) != "queued")
            .scalar_subquery()
        )
        query = (
            select(CalibrationRow)
            .where(col(CalibrationRow.spool) == spool, col(CalibrationRow.state) == "queued")
            .order_by(served_at.nulls_first(), col(CalibrationRow.number))
            .limit(1)
            .with_for_update()
        )
        with writing(self._engine) as session:
            row = session.exec(query).first()
            if row is None:
                return None
            row.state, row.attempts = "running", row.attempts + 1
            return _changed(session, row)

    def tell(self, calibration_id: str, progress: float, images: JsonValue) -> bool:
        """Note how far a running calibration is; whether it still runs."""
        with writing(self._engine) as session:
            row = _require_row(session, calibration_id, self._owner, lock=True)
            if row.state != "running":
                return False
            row.progress, row.images = min(max(progress, 0.0), 1.0), images
            _changed(session, row)
            return True

    def is_running(self, calibration_id: str) -> bool:
        """Whether it still runs: it does not once somebody cancelled it."""
        with reading(self._engine) as session:
            query = select(CalibrationRow.state).where(col(CalibrationRow.id) == calibration_id)
            return session.exec(query).first() == "running"

    def put_back(self, calibration_id: str) -> bool:
        """Queue a running calibration again, as if it had not been tried; whether it was running."""
        with writing(self._engine) as session:
            row = _require_row(session, calibration_id, self._owner, lock=True)
            if row.state != "running":
                return False
            row.state, row.attempts = "queued", row.attempts - 1
            row.progress, row.images = 0.0, []
            _changed(session, row)
            return True

    def finish(self, calibration_id: str, ending: Ending) -> bool:
        """End a running calibration and store its camera, both or neither; whether it was still running."""
        return again_if_beaten(self._finish, calibration_id, ending)

    def accept(self, calibration_id: str, name: str, camera: Camera) -> CalibrationRecord:
        """Store what a calibration found as a camera, new or at a new revision, once: again, it is as it was.

        Raises ``NotFound``, ``Conflict`` where it was accepted under another name.
        """
        return again_if_beaten(self._accept, calibration_id, name, camera)

    def cancel(self, calibration_id: str) -> State:
        """Cancel what has not ended; the state before. Raises ``NotFound``."""
        with writing(self._engine) as session:
            row = _require_row(session, calibration_id, self._owner, lock=True)
            before = STATE.validate_python(row.state)
            if before in LIVE:
                row.state = "cancelled"
                _changed(session, row)
            return before

    def recover(self, spool: str) -> None:
        """What the spool's last run left running is queued again; where there is nothing, that costs no lock."""
        if not self.live_counts(spool)["running"]:
            return
        now = datetime.now(UTC)
        again = (
            update(CalibrationRow)
            .where(col(CalibrationRow.spool) == spool, col(CalibrationRow.state) == "running")
            .values(state="queued", progress=0.0, images=[], version=CalibrationRow.version + 1, updated_at=now)
        )
        with writing(self._engine) as session:
            session.connection().execute(again)

    def give_up(self, spool: str, silent_for: timedelta = ABANDONED_AFTER) -> None:
        """What other spools have left alone for so long fails."""
        now = datetime.now(UTC)
        given_up = (
            update(CalibrationRow)
            .where(
                col(CalibrationRow.spool) != spool,
                col(CalibrationRow.state).in_(LIVE),
                col(CalibrationRow.updated_at) <= now - silent_for,
            )
            .values(
                state="failed",
                problem="The service that held its photographs did not come back: send them again.",
                version=CalibrationRow.version + 1,
                updated_at=now,
            )
        )
        with writing(self._engine) as session:
            session.connection().execute(given_up)

    def forget(self, ended_before: datetime) -> int:
        """Delete what ended before then, a few at a time so that nobody else waits long; how many. Cameras stay."""
        ended = (
            select(CalibrationRow.number)
            .where(~col(CalibrationRow.state).in_(LIVE), col(CalibrationRow.updated_at) < ended_before)
            .order_by(col(CalibrationRow.number))
        )
        if self._owner is not None:
            ended = ended.where(col(CalibrationRow.owner) == self._owner)
        forgotten = 0
        while True:
            count = self._forget(ended.limit(FORGOTTEN_AT_A_TIME))
            forgotten += count
            if count < FORGOTTEN_AT_A_TIME:
                return forgotten
            time.sleep(FORGETTING_PAUSE_S)

    def _forget(self, ended: SelectOfScalar[int] | SelectOfScalar[None]) -> int:
        with writing(self._engine) as session:
            numbers = session.exec(ended).all()
            session.connection().execute(delete(CalibrationRow).where(col(CalibrationRow.number).in_(numbers)))
        return len(numbers)

    def _add(self, draft: CalibrationDraft, once: Once | None) -> CalibrationRecord:
        now, owner = datetime.now(UTC), self._owner or LOCAL
        row = CalibrationRow(
            id=draft.id,
            owner=owner,
            spool=draft.spool,
            camera=draft.camera,
            state="queued",
            attempts=0,
            version=1,
            progress=0.0,
            created_at=now,
            updated_at=now,
            settings=draft.settings,
            pictures=[{"name": picture.name, "role": picture.role} for picture in draft.pictures],
            images=[],
        )
        with writing(self._engine) as session:
            earlier = outcome_of(session, owner, once) if once else None
            if earlier is not None:
                return _to_record(_require_row(session, earlier, self._owner))
            session.add(row)
            session.flush()
            if once:
                note(session, owner, once, row.id)
            return _to_record(row)

    def _finish(self, calibration_id: str, ending: Ending) -> bool:
        with writing(self._engine) as session:
            row = _require_row(session, calibration_id, self._owner, lock=True)
            if row.state != "running":
                return False
            if ending.camera is not None:
                row.camera_revision = store_calibrated(session, row.owner, row.camera, ending.camera).revision
            row.state, row.result, row.problem = ending.state, ending.result, ending.problem
            row.images = row.images if ending.images is None else ending.images
            row.progress = 1.0 if ending.state == "succeeded" else row.progress
            _changed(session, row)
            return True

    def _accept(self, calibration_id: str, name: str, camera: Camera) -> CalibrationRecord:
        with writing(self._engine) as session:
            row = _require_row(session, calibration_id, self._owner, lock=True)
            if row.camera_revision is None:
                row.camera_revision = store_calibrated(session, row.owner, name, camera).revision
                row.camera = name
                return _changed(session, row)
            if row.camera != name:
                raise Conflict(f"It is accepted already, as revision {row.camera_revision} of camera '{row.camera}'.")
            return _to_record(row)


def _require_row(session: Session, calibration_id: str, owner: str | None, *, lock: bool = False) -> CalibrationRow:
    """The row, where it is the owner's, or anybody's for no owner."""
    row = None
    if re.fullmatch(ID_PATTERN, calibration_id):
        query = select(CalibrationRow).where(col(CalibrationRow.id) == calibration_id)
        query = query if owner is None else query.where(col(CalibrationRow.owner) == owner)
        row = session.exec(query.with_for_update() if lock else query).first()
    if row is None:
        raise NotFound("There is no such calibration: GET /calibrations lists them.")
    return row


def _changed(session: Session, row: CalibrationRow) -> CalibrationRecord:
    row.version += 1
    row.updated_at = datetime.now(UTC)
    session.flush()
    return _to_record(row)


def _to_record(row: CalibrationRow) -> CalibrationRecord:
    pictures = tuple(StoredPicture(picture["name"], picture["role"]) for picture in row.pictures)
    return CalibrationRecord(
        draft=CalibrationDraft(row.id, row.spool, row.camera, row.settings, pictures),
        state=STATE.validate_python(row.state),
        progress=row.progress,
        images=row.images,
        result=row.result,
        problem=row.problem,
        camera_revision=row.camera_revision,
        attempts=row.attempts,
        version=row.version,
        created_at=row.created_at,
        updated_at=row.updated_at,
    )
