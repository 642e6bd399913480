"""The settings: one frozen object, read once from ``CAMIND_*`` variables and passed in.

Nothing else reads the environment, and nothing is read at import. A value out of bounds refuses to start.
"""

import os
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import AfterValidator, Field, ValidationError, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict
from sqlalchemy import URL, make_url
from sqlalchemy.exc import ArgumentError

from service.cores import available_cores

ENV_PREFIX = "CAMIND_"
SHIPPED_MODEL = Path(__file__).parent / "models"
INT8 = "int8"  # the folder, in a model folder, of the same model in int8
DATABASE_FILE = "camind.sqlite3"
DATABASE_SCHEMES = ("sqlite", "postgresql+psycopg")


class SettingsError(ValueError):
    """A setting that cannot be served with; the message names the variable and its bound."""


def _expanded(path: Path) -> Path:
    try:
        return path.expanduser()
    except RuntimeError as exc:
        raise ValueError(f"there is no such home: {exc}") from exc


def _listed(text: str) -> frozenset[str]:
    return frozenset(part.strip().lower() for part in text.split(",") if part)


Folder = Annotated[Path, AfterValidator(_expanded)]
Kind = TypeVar("Kind", bound="StorageSettings")


def default_data_dir() -> Path:
    """Where the user's data belongs: ``$XDG_DATA_HOME/camind``, by default ``~/.local/share/camind``."""
    return Path(os.environ.get("XDG_DATA_HOME") or "~/.local/share") / "camind"


def default_otlp_endpoint() -> str:
    """Where traces go by OpenTelemetry's own variable; empty for nowhere."""
    return os.environ.get("OTEL_EXPORTER_OTLP_ENDPOINT", "")


class StorageSettings(BaseSettings):
    """Where the database and the service's files are: all that a command on them needs."""

    model_config = SettingsConfigDict(env_prefix=ENV_PREFIX, frozen=True, extra="forbid", env_ignore_empty=True)

    data_dir: Annotated[Folder, Field(description="Folder of the database and of the service's files")] = Field(
        default_factory=default_data_dir
    )
    database_url: Annotated[
        str, Field(description="SQLite or PostgreSQL (postgresql+psycopg://); empty: a file in data_dir")
    ] = ""

    @model_validator(mode="after")
    def _check_database(self) -> Self:
        scheme = self.database_url.partition(":")[0]
        if self.database_url and scheme not in DATABASE_SCHEMES:
            raise ValueError(f"{ENV_PREFIX}DATABASE_URL must begin with one of {', '.join(DATABASE_SCHEMES)}")
        try:
            url = self.effective_database_url
            url.get_dialect()().create_connect_args(url)
            if "@" in (url.host or ""):
                raise ValueError("a password ends at its first @")
        except (ArgumentError, ValueError) as exc:
            # what was read wrongly may be a part of the password
            raise ValueError(
                f"{ENV_PREFIX}DATABASE_URL cannot be read: write sqlite:////folder/file or "
                "postgresql+psycopg://user:password@host:port/name, other signs than letters and digits as %XX"
            ) from exc
        if self.is_database_embedded and (url.database in (None, "", ":memory:") or "uri" in url.query):
            raise ValueError(f"{ENV_PREFIX}DATABASE_URL names no file: write sqlite:////folder/file")
        return self

    @property
    def effective_database_url(self) -> URL:
        """The database's URL, the default file in the data folder filled in."""
        if self.database_url:
            return make_url(self.database_url)
        return URL.create("sqlite", database=str(self.data_dir.resolve() / DATABASE_FILE))

    @property
    def spool_dir(self) -> Path:
        """Where photographs lie until their calibration ends."""
        return self.data_dir.resolve() / "calibrations"

    @property
    def is_database_embedded(self) -> bool:
        """Whether the database is ours alone, and ``camind serve`` may migrate it."""
        return self.effective_database_url.get_backend_name() == "sqlite"


class Settings(StorageSettings):
    """Everything an operator can choose. Durations in seconds, sizes in bytes, images in pixels."""

    model_dir: Annotated[Folder, Field(description="Model folder to serve; default: the shipped model")] = SHIPPED_MODEL
    precision: Annotated[
        Literal["float32", "int8"], Field(description="Numbers the graphs compute with; int8: model_dir/int8")
    ] = "float32"

    host: Annotated[str, Field(min_length=1, description="Address to bind; default: this machine only")] = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535, description="TCP port; 0 lets the system choose")] = 8000

    api_keys: Annotated[
        Literal["auto", "on", "off"],
        Field(description="Whether requests need an API key; auto: unless only this machine can reach the service"),
    ] = "auto"
    key_requests_per_minute: Annotated[
        int, Field(ge=0, le=1_000_000, description="Requests of one API key in a minute; 0: no quota")
    ] = 600

    hosts: Annotated[
        str,
        Field(
            pattern=r"^([\w.-]+(, ?[\w.-]+)*)?$",
            description="Names, by commas, by which the service may be asked without API keys: a proxy's",
        ),
    ] = ""

    origins: Annotated[
        str,
        Field(
            pattern=r"^(https?://[\w.:\[\]-]+(, ?https?://[\w.:\[\]-]+)*)?$",
            description="Origins, by commas, whose web pages may ask too: https://app.example.org",
        ),
    ] = ""

    workers: Annotated[int, Field(ge=0, le=64, description="Images worked on at a time; 0: cores / 2")] = 0
    intra_op_threads: Annotated[int, Field(ge=0, le=64, description="Threads per image; 0: cores / workers")] = 0
    queue_size: Annotated[int, Field(ge=0, le=1000, description="Images that may wait for a worker")] = 16
    deadline_s: Annotated[float, Field(gt=0, le=600, description="Longest wait and work for one image")] = 120.0

    max_image_bytes: Annotated[
        int, Field(ge=1_000, le=1_000_000_000, description="Largest request body with an image")
    ] = 40_000_000
    max_image_pixels: Annotated[int, Field(ge=1_000, le=100_000_000, description="Largest image, width x height")] = (
        52_000_000
    )
    max_image_aspect: Annotated[
        float, Field(ge=1, le=1_000, description="Most elongated image, longer side / shorter side")
    ] = 10.0
    max_calibration_images: Annotated[int, Field(ge=1, le=1_000, description="Most photographs of one calibration")] = (
        100
    )
    max_calibration_bytes: Annotated[
        int, Field(ge=1_000, le=10_000_000_000, description="Largest request body with a calibration's photographs")
    ] = 1_000_000_000
    calibration_queue_size: Annotated[int, Field(ge=1, le=1_000, description="Calibrations that may wait")] = 8
    calibration_receive_deadline_s: Annotated[
        float, Field(gt=0, le=3_600, description="Longest time for a calibration's body slower than 32 kB/s")
    ] = 600.0
    max_json_bytes: Annotated[
        int, Field(ge=1_000, le=10_000_000, description="Largest request body without an image")
    ] = 64_000
    receive_deadline_s: Annotated[
        float,
        Field(gt=0, le=600, description="Longest time for a request's headers, and for a body slower than 32 kB/s"),
    ] = 30.0

    drain_s: Annotated[
        float, Field(ge=0, le=600, description="How long /health/ready says that the service stops before it does")
    ] = 1.0
    otlp_endpoint: Annotated[
        str,
        Field(
            pattern=r"^(https?://\S+)?$",
            description="OpenTelemetry collector for traces, http://HOST:4318; empty: none",
        ),
    ] = Field(default_factory=default_otlp_endpoint)

    log_level: Annotated[Literal["debug", "info", "warning", "error"], Field(description="Least level logged")] = "info"
    log_format: Annotated[
        Literal["console", "json"], Field(description="One event a line, for people or for machines")
    ] = "console"

    @model_validator(mode="after")
    def _check_threads(self) -> Self:
        cores = available_cores()
        if self.worker_slots * self.threads_per_worker > cores:
            raise ValueError(
                f"{ENV_PREFIX}WORKERS x {ENV_PREFIX}INTRA_OP_THREADS is "
                f"{self.worker_slots} x {self.threads_per_worker}, more than the {cores} cores: lower one"
            )
        return self

    @property
    def worker_slots(self) -> int:
        """Images worked on at a time."""
        return self.workers or max(1, available_cores() // max(2, self.intra_op_threads))

    @property
    def threads_per_worker(self) -> int:
        """Threads inside one graph run; times ``worker_slots`` at most the cores."""
        return self.intra_op_threads or max(1, available_cores() // self.worker_slots)

    @property
    def served_model_dir(self) -> Path:
        """The model folder whose graphs compute with the numbers that are wanted."""
        return self.model_dir / INT8 if self.precision == INT8 else self.model_dir

    @property
    def wants_keys(self) -> bool:
        """Whether a request needs an API key."""
        return self.api_keys == "on" or (self.api_keys == "auto" and not self.is_loopback)

    @property
    def known_hosts(self) -> frozenset[str]:
        """``hosts``, one by one."""
        return _listed(self.hosts)

    @property
    def known_origins(self) -> frozenset[str]:
        """``origins``, one by one."""
        return _listed(self.origins)

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine can reach the service."""
        try:
            return ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"


def load_settings(**overrides: object) -> Settings:
    """The settings from the environment, with the command line's ``overrides`` on top (``None``: not given).

    Raises ``SettingsError``, one line per wrong value.
    """
    return _load(Settings, {name: value for name, value in overrides.items() if value is not None})


def load_storage_settings() -> StorageSettings:
    """Those of them that say where the data are; the others may be wrong. Raises ``SettingsError``."""
    return _load(StorageSettings, {})


def _load(kind: type[Kind], given: dict[str, Any]) -> Kind:
    try:
        return kind(**given)
    except ValidationError as exc:
        raise SettingsError("\n".join(_fault_line(dict(fault)) for fault in exc.errors())) from exc


def _fault_line(fault: dict[str, object]) -> str:
    loc = fault["loc"]
    message = str(fault["msg"]).removeprefix("Value error, ")
    if not isinstance(loc, tuple) or not loc:
        return message
    return f"{ENV_PREFIX}{str(loc[0]).upper()}={fault['input']}: {message}"
