"""Shards and fits on local processes and on workers of a Dask cluster, which outlive the requesting service."""

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
from tests.service.data import ended, job, queue, running, stream, upload
from tests.service.runtime.work import home_length, kill_on_first_attempt, ordered_floats
from tests.service.server import Server
from tests.system.cluster.workers import cluster

SHARDS = range(20)


def sum_on(executor, work=ordered_floats):
    return sum_shards(executor, work, SHARDS, lambda: False)


def test_cluster_sum_is_identical_and_survives_lost_worker(shared, tmp_path):
    with shard_executor(Settings(home=tmp_path)) as inline:
        local_sum = sum_on(inline)
    with cluster(shared, tmp_path / "cluster", "one", "two") as workers:
        settings = shared.settings(cluster=workers.address)
        assert settings_to_send(settings) is None  # each worker has its own settings
        with shard_executor(settings) as executor:
            assert sum_on(executor).tobytes() == local_sum.tobytes()
            lengths = {len(str(shared.home(name))) for name in ("one", "two")}
            assert sum_on(executor, home_length)[0] in {len(SHARDS) * length for length in lengths}
            assert sum_on(executor, partial(kill_on_first_attempt, str(tmp_path))).tobytes() == local_sum.tobytes()
            assert sum_on(executor).tobytes() == local_sum.tobytes()  # by the remaining worker
            with pytest.raises(FitCancelledError):
                sum_shards(executor, ordered_floats, SHARDS, lambda: True)


def test_executor_requires_scheduler(shared):
    settings = shared.settings(cluster="tcp://127.0.0.1:1")
    with pytest.raises(ClusterUnavailableError, match="cannot be reached"), shard_executor(settings):
        pass
    assert not is_worker_lost(ValueError("wrong"))


FAST_TAKEOVER = {"LIPSERVE_REPLICA_LOST_S": "2"}
LONG = {"hyperparameter_samples": 150, "posterior_samples": 60, "max_iterations": 200}


def test_job_of_killed_service_is_served_by_another(shared, tmp_path):
    with cluster(shared, tmp_path / "cluster", "one") as workers:
        env = {**shared.env(), **FAST_TAKEOVER, "LIPSERVE_CLUSTER": workers.address}
        with Server(shared.home("b"), **env) as other:
            with Server(shared.home("a"), **env) as requester:
                data = upload(requester.client, stream(samples=300))
                seen = queue(requester.client, "away", data["id"], options=LONG)
                running(requester.client, seen["id"])
                requester.kill()
            assert job(other.client, seen["id"])["state"] in {"running", "succeeded"}
            now = ended(other.client, seen["id"])
            assert (now["state"], now["attempts"], now["version"]) == ("succeeded", 1, 1), now
            query = {"q": [[0.1, 0.2]], "dq": [[0, 0]], "ddq": [[0, 0]]}
            answer = other.client.post("/v1/models/away/predict", json=query)
            assert answer.status_code == 200, answer.text
            checks = {each["name"]: each for each in other.client.get("/health/ready").json()["checks"]}
            assert "the cluster runs up to 1 at a time" in checks["training"]["message"]
