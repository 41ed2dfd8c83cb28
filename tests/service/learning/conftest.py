"""A service that models learn in, shared by the tests: starting one starts a process."""

from collections.abc import Iterator
from itertools import count
from pathlib import Path

import pytest

from service.journal import restore
from service.models import registry
from service.storage.database import Database
from tests.service.conftest import Trained
from tests.service.data import service_of
from tests.service.learning import batches
from tests.service.learning.lessons import Pupil, School
from tests.service.learning.lessons import school as opened
from tests.service.learning.pendulums import Arm


@pytest.fixture(scope="session")
def school(api: object, trained: Trained, tmp_path_factory: pytest.TempPathFactory) -> Iterator[School]:
    """A service; every test enrols models of its own."""
    service = service_of(api)
    folder = service.files.version_folder(registry.find(service.database, trained.name, 1).folder)
    with opened(tmp_path_factory.mktemp("school"), folder) as started:
        yield started


NUMBERS = count()


@pytest.fixture
def pupil(school: School) -> Pupil:
    """A model that nobody else uses, whose data set the service does not have."""
    return school.enrol(f"own-{next(NUMBERS)}")


@pytest.fixture
def database(home: Path) -> Iterator[Database]:
    """Two models, whose log a test writes."""
    opened = batches.opened(home)
    yield opened
    opened.close()


@pytest.fixture
def arm(home: Path) -> Iterator[Arm]:
    """A model of one version."""
    opened = Arm.open(home)
    yield opened
    opened.database.close()


@pytest.fixture(params=[1, 25, 500], ids="pages of {} rows".format)
def pages(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages of one batch, of a few, and of all."""
    monkeypatch.setattr(restore, "PAGE_ROWS", request.param)
