"""A short test of shared resources: a PostgreSQL server, a folder of files, and a worker of a Dask cluster."""

from collections.abc import Iterator

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from fastapi.testclient import TestClient

from service.app import create_app
from service.runtime.executors import shard_executor, sum_shards
from service.storage.database import Base, Database
from tests.service.data import ADDRESS
from tests.service.learning.learning_models import observation_batch
from tests.service.runtime.work import ordered_floats
from tests.service.warm import warm_processes
from tests.system.cluster.pairs import Pair, predict_at_revision, train
from tests.system.cluster.servers import Postgres, Shared, sharing
from tests.system.cluster.workers import cluster

pytestmark = pytest.mark.journey


@pytest.fixture(scope="module", autouse=True)
def _warm_processes() -> Iterator[None]:
    with warm_processes():
        yield


@pytest.fixture(scope="module")
def shared_resources(postgres: Postgres, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shared]:
    """A database and a folder of files."""
    with sharing(postgres, None, tmp_path_factory.mktemp("journey")) as made:
        yield made


def test_migrations_create_tables_of_release(shared_resources: Shared) -> None:
    database = Database.of(shared_resources.settings("tables"))
    with database.engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), Base.metadata) == []
    database.close()


def test_services_learn_the_same_from_each_others_batches(shared_resources: Shared) -> None:
    trained = train(shared_resources.folder / "trained")
    settings = [shared_resources.settings(name, publish_every_s=0.02) for name in ("one", "two")]
    with TestClient(create_app(settings[0]), ADDRESS) as one, TestClient(create_app(settings[1]), ADDRESS) as two:
        arm = Pair((one, two), trained).enrol("arm")
        for number in range(6):
            revision = arm[number % 2].post("observations", observation_batch(number))["revision"]
        first, second = predict_at_revision(arm, revision)
    assert first["revision"] == 6
    assert first == second


def test_cluster_worker_sums_as_this_process_does(shared_resources: Shared) -> None:
    with shard_executor(shared_resources.settings()) as executor:
        here = sum_shards(executor, ordered_floats, range(20), lambda: False)
    with (
        cluster(shared_resources, shared_resources.folder / "cluster", "worker") as workers,
        shard_executor(shared_resources.settings(cluster=workers.address)) as executor,
    ):
        assert sum_shards(executor, ordered_floats, range(20), lambda: False).tobytes() == here.tobytes()
