"""What tests share: a real model folder, a scratch database made by the real migrations, the running app."""

from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
from fastapi import FastAPI
from hypothesis import settings as hypothesis_settings
from sqlalchemy import Engine, NullPool, create_engine
from starlette.testclient import TestClient

from service.app import create_app
from service.config import Settings
from service.storage import schema
from service.storage.cameras import Cameras
from service.storage.engine import open_engine
from tests import postgres
from tests.d200 import D200
from tests.fake_calibration import FakeCalibration
from tests.inference.oracle_pair import build_oracle_pair

# how busy the machine is says nothing of what is tested
hypothesis_settings.register_profile("unhurried", deadline=None)
hypothesis_settings.load_profile("unhurried")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--soak", action="store_true", help="the long version of tests that repeat")


@pytest.fixture(scope="session")
def is_soak(request: pytest.FixtureRequest) -> bool:
    """Whether the long version of tests that repeat is asked for."""
    return bool(request.config.getoption("--soak"))


@pytest.fixture(scope="session")
def tiny_model_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model folder whose pair is real, tiny, and has a known answer."""
    return build_oracle_pair(tmp_path_factory.mktemp("model"))


@pytest.fixture
def settings(tmp_path: Path, tiny_model_dir: Path) -> Settings:
    """Settings of a fresh service with small limits."""
    return Settings(
        data_dir=tmp_path / "data",
        model_dir=tiny_model_dir,
        workers=1,
        intra_op_threads=1,
        max_json_bytes=20_000,
        max_image_bytes=2_000_000,
        receive_deadline_s=5,
    )


@pytest.fixture
def fake() -> Iterator[FakeCalibration]:
    """Answers at once, unless ``go`` is cleared."""
    made = FakeCalibration()
    yield made
    made.go.set()


@pytest.fixture
def app(settings: Settings) -> FastAPI:
    return create_app(settings)


@pytest.fixture
def client(app: FastAPI) -> Iterator[TestClient]:
    """A client of the started app; the app's own 500 comes back as an answer."""
    with TestClient(app, raise_server_exceptions=False) as running:
        yield running


@pytest.fixture(scope="session")
def postgres_folder() -> Iterator[str]:
    """The socket's folder of a PostgreSQL cluster; fails where no server is installed."""
    binaries = postgres.find_binaries()
    if binaries is None:
        pytest.fail("these tests start a PostgreSQL server: install Debian's package postgresql, or put initdb on PATH")
    with postgres.running_cluster(binaries) as folder:
        yield folder


@pytest.fixture
def postgres_url(postgres_folder: str) -> str:
    """A new, empty PostgreSQL database."""
    name = f"scratch_{uuid4().hex}"
    server = create_engine(
        postgres.database_url(postgres_folder, "postgres"), isolation_level="AUTOCOMMIT", poolclass=NullPool
    )
    with server.connect() as connection:
        connection.exec_driver_sql(f"CREATE DATABASE {name}")
    return postgres.database_url(postgres_folder, name)


@pytest.fixture(params=["sqlite", "postgresql"])
def empty_engine(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Engine]:
    """An empty database: every test that asks runs on SQLite and on PostgreSQL."""
    is_sqlite = request.param == "sqlite"
    url = f"sqlite:///{tmp_path / 'scratch.sqlite3'}" if is_sqlite else request.getfixturevalue("postgres_url")
    scratch = open_engine(url)
    yield scratch
    scratch.dispose()


@pytest.fixture
def engine(empty_engine: Engine) -> Engine:
    """A database at the newest schema."""
    schema.upgrade(empty_engine)
    return empty_engine


@pytest.fixture
def cameras(engine: Engine) -> Cameras:
    return Cameras(engine)


@pytest.fixture
def d200() -> dict[str, Any]:
    """A camera from lens specs, as a client sends it; a test may change it."""
    return deepcopy(D200)


@pytest.fixture
def phone() -> dict[str, Any]:
    """A camera from its k_cam, as a client sends it."""
    return {
        "name": "pixel7-wide",
        "image_width_px": 4080,
        "image_height_px": 3072,
        "focus_distance_m": 2.0,
        "k_cam_px": 1.31,
        "gamma_px": 0.6,
    }
