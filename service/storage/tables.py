"""The tables. Rows stay in this package; everything else sees domain objects."""

from datetime import UTC, datetime

from pydantic import JsonValue
from sqlalchemy import JSON, Column, DateTime, Dialect, Index, MetaData, Text, UniqueConstraint
from sqlalchemy.types import TypeDecorator
from sqlmodel import Field, SQLModel

# constraints need names that every database agrees on, or no migration can drop them
SQLModel.metadata.naming_convention = {
    "ix": "ix_%(column_0_label)s",
    "uq": "uq_%(table_name)s_%(column_0_N_name)s",
    "ck": "ck_%(table_name)s_%(constraint_name)s",
    "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
    "pk": "pk_%(table_name)s",
}
metadata: MetaData = SQLModel.metadata


class UtcDateTime(TypeDecorator[datetime]):
    """Aware UTC in Python on every database; SQLite alone forgets the zone."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, _dialect: Dialect) -> datetime | None:
        if value is not None and value.tzinfo is None:
            raise ValueError("a stored time needs a zone")
        return value and value.astimezone(UTC)

    def process_result_value(self, value: datetime | None, _dialect: Dialect) -> datetime | None:
        return value and (value if value.tzinfo else value.replace(tzinfo=UTC)).astimezone(UTC)


class CameraRow(SQLModel, table=True):
    """An owner's name and the revision it stands for now; a deleted one keeps its row, and its count of revisions."""

    __tablename__ = "cameras"
    __table_args__ = (UniqueConstraint("owner", "name"),)

    id: int | None = Field(default=None, primary_key=True)
    owner: str = Field(max_length=64)
    name: str = Field(max_length=64)
    revision: int
    created_at: datetime = Field(sa_type=UtcDateTime)
    updated_at: datetime = Field(sa_type=UtcDateTime)
    deleted_at: datetime | None = Field(default=None, sa_type=UtcDateTime)


class CameraRevisionRow(SQLModel, table=True):
    """What a camera was at one revision, as it was given; written once, never changed."""

    __tablename__ = "camera_revisions"
    __table_args__ = (UniqueConstraint("camera_id", "revision"),)

    id: int | None = Field(default=None, primary_key=True)
    camera_id: int = Field(foreign_key="cameras.id")
    revision: int
    created_at: datetime = Field(sa_type=UtcDateTime)
    description: str | None = Field(default=None, max_length=1000)
    source: str = Field(max_length=16)
    image_width_px: int
    image_height_px: int
    focus_distance_m: float
    k_cam_px: float
    gamma_px: float
    k_r: float
    focal_length_mm: float | None = None
    f_number: float | None = None
    pixel_pitch_um: float | None = None
    sensor_width_px: int | None = None
    fx_px: float | None = None
    fy_px: float | None = None
    cx_px: float | None = None
    cy_px: float | None = None
    distortion: list[float] | None = Field(default=None, sa_column=Column(JSON(none_as_null=True), nullable=True))


class CalibrationRow(SQLModel, table=True):
    """A calibration: what was asked, how far it is, and what came of it; kept when its photographs are gone."""

    __tablename__ = "calibrations"
    __table_args__ = (UniqueConstraint("id"), Index("ix_calibrations_owner_number", "owner", "number"))

    # the order they came in; clients know the id alone
    number: int | None = Field(default=None, primary_key=True)
    id: str = Field(max_length=32)
    owner: str = Field(max_length=64)
    spool: str = Field(max_length=32)
    camera: str = Field(max_length=64)
    state: str = Field(max_length=16, index=True)
    attempts: int
    version: int
    progress: float
    created_at: datetime = Field(sa_type=UtcDateTime)
    updated_at: datetime = Field(sa_type=UtcDateTime)
    camera_revision: int | None = None
    problem: str | None = Field(default=None, sa_type=Text)
    settings: JsonValue = Field(sa_column=Column(JSON, nullable=False))
    pictures: list[dict[str, str]] = Field(sa_column=Column(JSON, nullable=False))
    images: JsonValue = Field(sa_column=Column(JSON, nullable=False))
    result: JsonValue = Field(default=None, sa_column=Column(JSON(none_as_null=True), nullable=True))


class ApiKeyRow(SQLModel, table=True):
    """An API key: its public half, a hash of its secret half, and what it may do; kept when it is revoked."""

    __tablename__ = "api_keys"

    id: str = Field(primary_key=True, max_length=16)
    digest: str = Field(max_length=64)
    name: str = Field(max_length=64)
    owner: str = Field(max_length=64)
    scopes: list[str] = Field(sa_column=Column(JSON, nullable=False))
    created_at: datetime = Field(sa_type=UtcDateTime)
    expires_at: datetime | None = Field(default=None, sa_type=UtcDateTime)
    last_used_at: datetime | None = Field(default=None, sa_type=UtcDateTime)
    revoked_at: datetime | None = Field(default=None, sa_type=UtcDateTime)


class IdempotencyRow(SQLModel, table=True):
    """What an owner's Idempotency-Key was used for: a hash of the request, and what came of it."""

    __tablename__ = "idempotency_keys"

    owner: str = Field(primary_key=True, max_length=64)
    key: str = Field(primary_key=True, max_length=255)
    fingerprint: str = Field(max_length=64)
    outcome: str = Field(max_length=80)
    created_at: datetime = Field(sa_type=UtcDateTime, index=True)
