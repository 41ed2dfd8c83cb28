"""Fixtures of the learning tests; the service is shared because starting it starts a process."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from service.journal import restore
from service.models import registry
from service.storage.database import Database
from tests.service.conftest import Trained
from tests.service.data import service_of
from tests.service.learning import batches
from tests.service.learning.learning_models import LearningModel, LearningService, start_service
from tests.service.learning.pendulums import Arm


@pytest.fixture(scope="session")
def learning_service(
    api: object, trained: Trained, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[LearningService]:
    """Service with learning; every test creates its own models."""
    service = service_of(api)
    folder = service.files.version_folder(registry.find(service.database, trained.name, 1).folder)
    with start_service(tmp_path_factory.mktemp("school"), folder) as started:
        yield started


@pytest.fixture
def learning_model(learning_service: LearningService) -> LearningModel:
    """Model of one test, whose data set is not in the service."""
    return learning_service.create_model()


@pytest.fixture
def database(home: Path) -> Iterator[Database]:
    """Database with two models whose logs a test writes."""
    opened_database = batches.open_database(home)
    yield opened_database
    opened_database.close()


@pytest.fixture
def arm(home: Path) -> Iterator[Arm]:
    """Model with one version."""
    opened_arm = Arm.open(home)
    yield opened_arm
    opened_arm.database.close()


@pytest.fixture(params=[1, 25, 500], ids="pages of {} rows".format)
def pages(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Read the log in pages of one batch, of a few, and of all."""
    monkeypatch.setattr(restore, "PAGE_ROWS", request.param)
