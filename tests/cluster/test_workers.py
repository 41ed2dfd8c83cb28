"""Shards and fits on processes of this host and on workers of a Dask cluster, which outlive the service that asked."""

from functools import partial

import pytest

from lipcore.estimators.hyperparameters import FitCancelledError
from service.foundation.settings import Settings
from service.runtime.executors import (
    ClusterUnavailableError,
    is_worker_lost,
    settings_to_send,
    shard_executor,
    sum_shards,
)
from tests.cluster.workers import cluster
from tests.service.data import ended, job, queue, running, stream, upload
from tests.service.runtime.work import dying, home, numbers
from tests.service.server import Server

SHARDS = range(20)


def summed_by(executor, work=numbers):
    return sum_shards(executor, work, SHARDS, lambda: False)


@pytest.mark.slow
def test_workers_of_a_cluster_come_to_the_same_sum_and_a_lost_one_costs_nothing(shared, tmp_path):
    with shard_executor(Settings(home=tmp_path)) as inline:
        once = summed_by(inline)
    with cluster(shared, tmp_path / "cluster", "one", "two") as workers:
        settings = shared.settings(cluster=workers.address)
        assert settings_to_send(settings) is None  # each has its own
        with shard_executor(settings) as executor:
            assert summed_by(executor).tobytes() == once.tobytes()
            lengths = {len(str(shared.home(name))) for name in ("one", "two")}
            assert summed_by(executor, home)[0] in {len(SHARDS) * length for length in lengths}
            assert summed_by(executor, partial(dying, str(tmp_path))).tobytes() == once.tobytes()
            assert summed_by(executor).tobytes() == once.tobytes()  # by the one that is left
            with pytest.raises(FitCancelledError):
                sum_shards(executor, numbers, SHARDS, lambda: True)


@pytest.mark.slow
def test_without_a_scheduler_there_is_no_executor(shared):
    settings = shared.settings(cluster="tcp://127.0.0.1:1")
    with pytest.raises(ClusterUnavailableError, match="cannot be reached"), shard_executor(settings):
        pass
    assert not is_worker_lost(ValueError("wrong"))


LOST_SOON = {"LIPSERVE_REPLICA_LOST_S": "2"}
LONG = {"hyperparameter_samples": 150, "posterior_samples": 60, "max_iterations": 200}


@pytest.mark.slow
def test_another_service_answers_by_the_model_that_a_killed_one_was_asked_for(shared, tmp_path):
    with cluster(shared, tmp_path / "cluster", "one") as workers:
        env = {**shared.env(), **LOST_SOON, "LIPSERVE_CLUSTER": workers.address}
        with Server(shared.home("b"), **env) as other:
            with Server(shared.home("a"), **env) as asked:
                data = upload(asked.client, stream(samples=300))
                seen = queue(asked.client, "away", data["id"], options=LONG)
                running(asked.client, seen["id"])
                asked.kill()
            assert job(other.client, seen["id"])["state"] in {"running", "succeeded"}
            now = ended(other.client, seen["id"])
            assert (now["state"], now["attempts"], now["version"]) == ("succeeded", 1, 1), now
            query = {"q": [[0.1, 0.2]], "dq": [[0, 0]], "ddq": [[0, 0]]}
            answer = other.client.post("/v1/models/away/predict", json=query)
            assert answer.status_code == 200, answer.text
            checks = {each["name"]: each for each in other.client.get("/health/ready").json()["checks"]}
            assert "the cluster takes 1 at a time" in checks["training"]["message"]
