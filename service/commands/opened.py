"""The settings and the database that commands work with."""

from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy import Engine

from service.commands.failures import WRONG_USE, plain_failures
from service.config import Settings, StorageSettings, load_settings, load_storage_settings


def settings_with(**overrides: object) -> Settings:
    """The service's settings, some of them as the command line has them where these are not None."""
    with plain_failures(WRONG_USE):
        return load_settings(**overrides)


def storage_settings() -> StorageSettings:
    """Where the data are: how they are served is no matter of a command on them."""
    with plain_failures(WRONG_USE):
        return load_storage_settings()


@contextmanager
def opened(settings: StorageSettings, *, is_migrated: bool = False) -> Iterator[Engine]:
    """The configured database, which nobody restores meanwhile; one that others share is migrated only where asked."""
    from service.storage import schema
    from service.storage.backup import using
    from service.storage.engine import open_engine

    with using(settings.effective_database_url):
        engine = open_engine(settings.effective_database_url)
        try:
            if is_migrated or settings.is_database_embedded:
                schema.upgrade(engine)
            yield engine
        finally:
            engine.dispose()


@contextmanager
def ready_engine() -> Iterator[Engine]:
    """The configured database, at the newest schema; what fails with it is a message."""
    from service.storage import schema

    with plain_failures(), opened(storage_settings()) as engine:
        schema.require_head(engine)
        yield engine
