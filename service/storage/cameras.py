"""Cameras in the database: a name, its current revision, and every revision it ever had.

A revision is written once and never changed. A deleted name is free again, and the camera registered next
under it goes on counting: a name with a revision number means the same numbers for ever.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal

from pydantic import TypeAdapter
from sqlalchemy import BindParameter, Engine, bindparam, func
from sqlmodel import Session, col, select
from sqlmodel.sql.expression import Select

from service.errors import BadRequest, Conflict, NotFound, PreconditionFailed
from service.optics.camera import Camera, Intrinsics, Lens
from service.optics.thin_lens import K_R_OF_DISC
from service.principal import LOCAL
from service.storage.engine import again_if_beaten, reading, writing
from service.storage.idempotency import Once, note, outcome_of
from service.storage.tables import CameraRevisionRow, CameraRow

NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"

Source = Literal["given", "lens", "calibration"]
SOURCE: TypeAdapter[Source] = TypeAdapter(Source)


@dataclass(frozen=True, slots=True)
class CameraDraft:
    """A camera before it is stored: what depth needs, and what it was made from."""

    name: str
    camera: Camera
    source: Source
    lens: Lens | None = None
    description: str | None = None

    @property
    def k_r(self) -> float:
        """Diameter of the circle of confusion over the standard deviation that k_cam stands for."""
        return self.lens.k_r if self.lens else K_R_OF_DISC

    @property
    def with_focal_length(self) -> Camera:
        """The camera with intrinsics where its lens tells them, the principal point in the middle."""
        return self.camera.seen_through(self.lens) if self.lens and self.camera.intrinsics is None else self.camera


@dataclass(frozen=True, slots=True)
class CameraRecord:
    """A stored camera at one revision; times are UTC."""

    draft: CameraDraft
    revision: int
    created_at: datetime
    updated_at: datetime

    @property
    def name(self) -> str:
        return self.draft.name

    @property
    def camera(self) -> Camera:
        return self.draft.camera


class Cameras:
    """An owner's cameras in one database; safe to share between threads. Another owner's are as if not there."""

    def __init__(self, engine: Engine, owner: str = LOCAL) -> None:
        self._engine = engine
        self._owner = owner

    def add(self, draft: CameraDraft, once: Once | None = None) -> CameraRecord:
        """Store a new camera; with ``once``, the one that the same request stored before.

        Raises ``Conflict`` where the name is taken, ``KeyReused`` where ``once`` came with another request.
        """
        return again_if_beaten(self._add, draft, once)

    def get(self, name: str) -> CameraRecord:
        """The camera at its current revision. Raises ``NotFound``."""
        with reading(self._engine) as session:
            return _to_record(*_current(session, self._owner, name))

    def page(self, limit: int, after: str | None = None) -> tuple[list[CameraRecord], bool]:
        """Up to ``limit`` cameras by name, from the one behind ``after``; and whether there are more."""
        query = _all_current(self._owner).order_by(col(CameraRow.name)).limit(limit + 1)
        if after is not None:
            query = query.where(col(CameraRow.name) > after)
        with reading(self._engine) as session:
            records = [_to_record(row, revision) for row, revision in session.exec(query)]
        return records[:limit], len(records) > limit

    def revisions(self, name: str, limit: int, before: int | None = None) -> tuple[list[CameraRecord], bool]:
        """Up to ``limit`` revisions, the newest first, from the one before ``before``; and whether there are more.

        Those of a deleted camera that has or had the name are among them. Raises ``NotFound`` where none ever had it.
        """
        with reading(self._engine) as session:
            row = _find_row(session, self._owner, name)
            if row is None:
                raise _unknown(name)
            query = select(CameraRevisionRow).where(col(CameraRevisionRow.camera_id) == row.id)
            if before is not None:
                query = query.where(col(CameraRevisionRow.revision) < before)
            found = session.exec(query.order_by(col(CameraRevisionRow.revision).desc()).limit(limit + 1))
            records = [_to_past(row, revision) for revision in found]
        return records[:limit], len(records) > limit

    def replace(self, draft: CameraDraft, expected: Sequence[int] | None = None) -> CameraRecord:
        """Store a new revision of a camera.

        Raises ``NotFound``, and ``PreconditionFailed`` where its revision is none of those ``expected``.
        """
        with writing(self._engine) as session:
            row = _require_row(session, self._owner, draft.name, expected)
            return _write_revision(session, row, draft, datetime.now(UTC))

    def store_calibrated(self, name: str, camera: Camera) -> CameraRecord:
        """Make the camera or give it a new revision, as a calibration found it."""
        with writing(self._engine) as session:
            return store_calibrated(session, self._owner, name, camera)

    def delete(self, name: str, expected: Sequence[int] | None = None) -> None:
        """Free the name; the revisions stay. Raises as ``replace`` does."""
        with writing(self._engine) as session:
            row = _require_row(session, self._owner, name, expected)
            row.deleted_at = datetime.now(UTC)

    def _add(self, draft: CameraDraft, once: Once | None) -> CameraRecord:
        now = datetime.now(UTC)
        with writing(self._engine) as session:
            # the camera first: one that another process stored just now has its outcome beside it
            row = _find_row(session, self._owner, draft.name, lock=True)
            stored = outcome_of(session, self._owner, once) if once else None
            if stored is not None:
                return _as_added(session, self._owner, draft.name, int(stored))
            if row is not None and row.deleted_at is None:
                raise _taken(draft.name)
            row = row or CameraRow(owner=self._owner, name=draft.name, revision=0, created_at=now, updated_at=now)
            row.created_at, row.deleted_at = now, None
            record = _write_revision(session, row, draft, now)
            if once:
                note(session, self._owner, once, str(record.revision))
            return record


def camera_counts(engine: Engine, name: str | None = None) -> dict[str, int]:
    """How many cameras each owner has, of that ``name`` where one is given; owners without any are left out."""
    owner = col(CameraRow.owner)
    query = select(owner, func.count()).where(col(CameraRow.deleted_at).is_(None))
    if name is not None:
        if not _is_name(name):
            return {}
        query = query.where(col(CameraRow.name) == name)
    with reading(engine) as session:
        return dict(session.exec(query.group_by(owner).order_by(owner)).all())


def has_had_cameras(engine: Engine) -> bool:
    """Whether anybody ever had a camera, deleted ones too."""
    with reading(engine) as session:
        return session.exec(select(col(CameraRow.id)).limit(1)).first() is not None


def require_name(name: str) -> None:
    """Raise ``BadRequest`` for what is no name."""
    if not _is_name(name):
        raise BadRequest(f"'{name[:80]}' is no name for a camera: letters, digits, '.', '_' and '-', 64 at most.")


def store_calibrated(session: Session, owner: str, name: str, camera: Camera) -> CameraRecord:
    """Make the camera, or give it a new revision, with constants from a calibration; the description stays.

    For a caller's own transaction: an ``IntegrityError`` means that another process just made the name.
    """
    now = datetime.now(UTC)
    row = _find_row(session, owner, name, lock=True)
    if row is None or row.deleted_at is not None:
        row = row or CameraRow(owner=owner, name=name, revision=0, created_at=now, updated_at=now)
        row.created_at, row.deleted_at, description = now, None, None
    else:
        description = _current(session, owner, name)[1].description
    return _write_revision(session, row, CameraDraft(name, camera, "calibration", description=description), now)


def _taken(name: str) -> Conflict:
    return Conflict.at(f"A camera '{name}' exists already: replace it with PUT /cameras/{name}.", "#/name")


def _unknown(name: str) -> NotFound:
    return NotFound(f"There is no camera '{name[:64]}': register it with POST /cameras.")


def _is_name(name: str) -> bool:
    """What is no name is in no table, and PostgreSQL refuses some of it (a NUL) outright."""
    return re.fullmatch(NAME_PATTERN, name) is not None


def _find_row(session: Session, owner: str, name: str, *, lock: bool = False) -> CameraRow | None:
    if not _is_name(name):
        return None
    query = select(CameraRow).where(col(CameraRow.owner) == owner, col(CameraRow.name) == name)
    return session.exec(query.with_for_update() if lock else query).first()


def _require_row(session: Session, owner: str, name: str, expected: Sequence[int] | None) -> CameraRow:
    """The row, locked until the end of the transaction, at one of the expected revisions."""
    row = _find_row(session, owner, name, lock=True)
    if row is None or row.deleted_at is not None:
        raise _unknown(name)
    if expected is not None and row.revision not in expected:
        remedy = f'read it again, then repeat with If-Match: "{row.revision}"'
        raise PreconditionFailed(f"Camera '{name}' is at revision {row.revision}: {remedy}.")
    return row


_WITH_REVISIONS = select(CameraRow, CameraRevisionRow).join(
    CameraRevisionRow, col(CameraRevisionRow.camera_id) == col(CameraRow.id)
)


def _all_current(owner: str | BindParameter[str]) -> Select[CameraRow, CameraRevisionRow]:
    """The cameras that an owner has, each with its current revision."""
    return _WITH_REVISIONS.where(
        col(CameraRevisionRow.revision) == col(CameraRow.revision),
        col(CameraRow.owner) == owner,
        col(CameraRow.deleted_at).is_(None),
    )


# building it anew takes as long as asking it, and every photograph asks it
_CURRENT = _all_current(bindparam("owner")).where(col(CameraRow.name) == bindparam("name"))


def _current(session: Session, owner: str, name: str) -> tuple[CameraRow, CameraRevisionRow]:
    found = session.exec(_CURRENT, params={"owner": owner, "name": name}).first() if _is_name(name) else None
    if found is None:
        raise _unknown(name)
    return found


def _as_added(session: Session, owner: str, name: str, number: int) -> CameraRecord:
    """A camera as it was when it was added, whatever became of it since."""
    query = _WITH_REVISIONS.where(
        col(CameraRow.owner) == owner, col(CameraRow.name) == name, col(CameraRevisionRow.revision) == number
    )
    return _to_past(*session.exec(query).one())


def _write_revision(session: Session, row: CameraRow, draft: CameraDraft, now: datetime) -> CameraRecord:
    row.revision += 1
    row.updated_at = now
    session.add(row)
    session.flush()
    if row.id is None:
        raise RuntimeError("the database gave the camera no id")
    revision = _to_revision_row(row.id, row.revision, draft, now)
    session.add(revision)
    session.flush()
    return _to_record(row, revision)


def _to_revision_row(camera_id: int, number: int, draft: CameraDraft, now: datetime) -> CameraRevisionRow:
    camera, lens, intrinsics = draft.camera, draft.lens, draft.camera.intrinsics
    return CameraRevisionRow(
        camera_id=camera_id,
        revision=number,
        created_at=now,
        description=draft.description,
        source=draft.source,
        image_width_px=camera.image_width_px,
        image_height_px=camera.image_height_px,
        focus_distance_m=camera.focus_distance_m,
        k_cam_px=camera.k_cam_px,
        gamma_px=camera.gamma_px,
        k_r=draft.k_r,
        focal_length_mm=lens.focal_length_mm if lens else None,
        f_number=lens.f_number if lens else camera.f_number,
        pixel_pitch_um=lens.pixel_pitch_um if lens else None,
        sensor_width_px=lens.sensor_width_px if lens else None,
        fx_px=intrinsics.fx_px if intrinsics else None,
        fy_px=intrinsics.fy_px if intrinsics else None,
        cx_px=intrinsics.cx_px if intrinsics else None,
        cy_px=intrinsics.cy_px if intrinsics else None,
        distortion=list(intrinsics.distortion) if intrinsics else None,
    )


def _to_record(row: CameraRow, revision: CameraRevisionRow) -> CameraRecord:
    lens = _to_lens(revision)
    camera = Camera(
        image_width_px=revision.image_width_px,
        image_height_px=revision.image_height_px,
        focus_distance_m=revision.focus_distance_m,
        k_cam_px=revision.k_cam_px,
        gamma_px=revision.gamma_px,
        focal_length_m=lens.focal_length_m if lens else None,
        f_number=revision.f_number,
        intrinsics=_to_intrinsics(revision),
    )
    draft = CameraDraft(row.name, camera, SOURCE.validate_python(revision.source), lens, revision.description)
    return CameraRecord(draft, revision.revision, row.created_at, row.updated_at)


def _to_past(row: CameraRow, revision: CameraRevisionRow) -> CameraRecord:
    """A camera as it was at a revision, with the time that was written."""
    return CameraRecord(_to_record(row, revision).draft, revision.revision, revision.created_at, revision.created_at)


def _to_lens(row: CameraRevisionRow) -> Lens | None:
    if row.focal_length_mm is None or row.f_number is None or row.pixel_pitch_um is None or row.sensor_width_px is None:
        return None
    return Lens(row.focal_length_mm, row.f_number, row.pixel_pitch_um, row.sensor_width_px, row.k_r)


def _to_intrinsics(row: CameraRevisionRow) -> Intrinsics | None:
    if row.fx_px is None or row.fy_px is None or row.cx_px is None or row.cy_px is None:
        return None
    return Intrinsics(row.fx_px, row.fy_px, row.cx_px, row.cy_px, tuple(row.distortion or ()))
