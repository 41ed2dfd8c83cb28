"""A service that requires keys, in this process."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import pytest
from fastapi.testclient import TestClient
from httpx import Client

from service.api.access import keys
from service.api.access.scopes import SCOPES
from service.app import create_app
from service.foundation.settings import Settings
from service.storage.database import Database
from tests.service.cli.conftest import lipserve, run_command, run_on_server  # noqa: F401 - fixtures
from tests.service.data import eventually

REFRESH_S = 0.05


@dataclass(frozen=True)
class KeyedService:
    """A service that requires keys, one key of each scope, and a connection to its database like the CLI's."""

    api: Client
    secrets: dict[str, str]
    database: Database

    def make(self, *scopes: str) -> tuple[str, str]:
        """Make a key, wait until the service knows it, and return its id and the key."""
        row, secret = keys.create(self.database, "test", scopes, None)
        eventually(lambda: self.get(secret).status_code != 401)
        return row.id, secret

    def get(self, secret: str, path: str = "/v1/models") -> Any:
        """Read an address with a key."""
        return self.api.get(path, headers=bearer(secret))


def bearer(secret: str) -> dict[str, str]:
    """Return the header with a key."""
    return {"Authorization": f"Bearer {secret}"}


@pytest.fixture(scope="package")
def keyed_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[KeyedService]:
    """A service that requires keys."""
    home = tmp_path_factory.mktemp("guarded")
    database = Database.of(Settings(home=home))
    secrets = {scope: keys.create(database, f"only {scope}", [scope], None)[1] for scope in SCOPES}
    with patch("service.app.REFRESH_S", REFRESH_S):
        app = create_app(Settings(home=home, keys="on"))
    with TestClient(app, "http://robot.example") as api:
        yield KeyedService(api, secrets, database)
    database.close()


@pytest.fixture
def keys_database(home) -> Iterator[Database]:
    """An empty database."""
    opened = Database.of(Settings(home=home))
    yield opened
    opened.close()
