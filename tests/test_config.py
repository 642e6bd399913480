"""Settings come from CAMIND_ variables, have bounds, and refuse to start with what lies beyond."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from service.config import SHIPPED_MODEL, Settings, SettingsError, load_settings
from service.cores import available_cores
from service.storage.engine import open_engine


@pytest.fixture(autouse=True)
def _only_these(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    import os

    for name in [name for name in os.environ if name.startswith("CAMIND_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))


def test_the_defaults_serve_this_machine_only(tmp_path: Path) -> None:
    settings = load_settings()
    assert settings.is_loopback
    assert settings.port == 8000
    assert settings.model_dir == SHIPPED_MODEL
    assert str(settings.effective_database_url) == f"sqlite:///{tmp_path / 'camind' / 'camind.sqlite3'}"
    assert settings.worker_slots * settings.threads_per_worker <= available_cores()


def test_variables_and_then_the_command_line_win(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CAMIND_PORT", "9000")
    monkeypatch.setenv("CAMIND_HOST", "192.0.2.1")
    monkeypatch.setenv("CAMIND_DATA_DIR", str(tmp_path / "own"))
    settings = load_settings(port=9001, host=None)
    assert settings.port == 9001
    assert not settings.is_loopback
    assert settings.effective_database_url.database == str(tmp_path / "own" / "camind.sqlite3")


@pytest.mark.parametrize("name", ["what?", "a%41", "a b#c;d&e=f", "große"])
def test_any_folder_holds_the_database(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str) -> None:
    monkeypatch.setenv("CAMIND_DATA_DIR", str(tmp_path / name))
    engine = open_engine(load_settings().effective_database_url)
    engine.connect().close()
    engine.dispose()
    assert [path.name for path in (tmp_path / name).iterdir()] == ["camind.sqlite3"]
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_folders_may_begin_with_the_user_s_own(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("CAMIND_DATA_DIR", "~/data")
    monkeypatch.setenv("CAMIND_MODEL_DIR", "~/model")
    settings = load_settings()
    assert settings.effective_database_url.database == str(tmp_path / "data" / "camind.sqlite3")
    assert settings.served_model_dir == tmp_path / "model"


def test_a_user_without_a_home_is_told_which_folder_to_name(monkeypatch: pytest.MonkeyPatch) -> None:
    def nobody(_: int) -> None:
        raise KeyError

    for name in ("HOME", "XDG_DATA_HOME"):
        monkeypatch.delenv(name)
    monkeypatch.setattr("pwd.getpwuid", nobody)
    with pytest.raises(SettingsError, match=r"^CAMIND_DATA_DIR=.*no such home"):
        load_settings()
    monkeypatch.setenv("CAMIND_DATA_DIR", "/somewhere")
    assert load_settings().data_dir == Path("/somewhere")


def test_an_empty_variable_counts_as_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAMIND_PORT", "")
    assert load_settings().port == 8000


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("PORT", "70000"),
        ("PORT", "http"),
        ("DEADLINE_S", "0"),
        ("DEADLINE_S", "nan"),
        ("QUEUE_SIZE", "-1"),
        ("MAX_IMAGE_PIXELS", "0"),
        ("MAX_IMAGE_BYTES", "1e12"),
        ("MAX_IMAGE_ASPECT", "0.5"),
        ("RECEIVE_DEADLINE_S", "inf"),
        ("CALIBRATION_RECEIVE_DEADLINE_S", "inf"),
        ("DRAIN_S", "-1"),
        ("MAX_CALIBRATION_IMAGES", "0"),
        ("MAX_CALIBRATION_BYTES", "1e12"),
        ("CALIBRATION_QUEUE_SIZE", "0"),
        ("OTLP_ENDPOINT", "collector:4318"),
        ("LOG_LEVEL", "loud"),
        ("LOG_FORMAT", "xml"),
        ("DATABASE_URL", "mysql://localhost/camind"),
        ("DATABASE_URL", "postgresql://localhost/camind"),
        ("DATABASE_URL", "nonsense"),
        ("DATABASE_URL", "postgresql+psycopg://u:p@h:abc/db"),
        ("DATABASE_URL", "sqlite:/x"),
        ("DATABASE_URL", "sqlite://"),
        ("DATABASE_URL", "sqlite:///:memory:"),
        ("DATABASE_URL", "sqlite:///file::memory:?uri=true"),
        ("DATABASE_URL", "sqlite:////x?timeout=abc"),
        ("DATA_DIR", "~nobody-has-this-name/x"),
        ("MODEL_DIR", "~nobody-has-this-name/x"),
        ("WORKERS", "-1"),
    ],
)
def test_a_wrong_value_is_named(monkeypatch: pytest.MonkeyPatch, name: str, value: str) -> None:
    monkeypatch.setenv(f"CAMIND_{name}", value)
    with pytest.raises(SettingsError, match=f"CAMIND_{name}"):
        load_settings()


@pytest.mark.parametrize("password", ["x@y:hunter", "x@hunter"])
def test_a_wrong_url_s_password_is_not_said(monkeypatch: pytest.MonkeyPatch, password: str) -> None:
    monkeypatch.setenv("CAMIND_DATABASE_URL", f"postgresql+psycopg://u:{password}@h/db")
    with pytest.raises(SettingsError, match="as %XX") as refused:
        load_settings()
    assert "hunter" not in str(refused.value)


def test_more_threads_than_cores_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.config.available_cores", lambda: 4)
    settings = load_settings(workers=2)
    assert (settings.worker_slots, settings.threads_per_worker) == (2, 2)
    assert load_settings(intra_op_threads=1).worker_slots == 2
    with pytest.raises(SettingsError, match="3 x 2, more than the 4 cores"):
        load_settings(workers=3, intra_op_threads=2)
    with pytest.raises(SettingsError, match="8 x 1"):
        load_settings(workers=8)


@pytest.mark.parametrize("cores", [1, 2, 3, 8, 64])
def test_the_defaults_fit_every_machine(monkeypatch: pytest.MonkeyPatch, cores: int) -> None:
    monkeypatch.setattr("service.config.available_cores", lambda: cores)
    settings = load_settings()
    assert 1 <= settings.worker_slots * settings.threads_per_worker <= cores


def test_settings_do_not_change() -> None:
    settings = load_settings()
    with pytest.raises(ValidationError):
        settings.__setattr__("port", 1)


def test_every_setting_says_what_it_means() -> None:
    assert all(field.description for field in Settings.model_fields.values())
