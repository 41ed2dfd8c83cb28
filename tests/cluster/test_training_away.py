"""A real fit on a worker of a Dask cluster, which outlives the service that was asked for it."""

from __future__ import annotations

import pytest

from tests.cluster.workers import cluster
from tests.service.data import ended, job, queue, running, stream, upload
from tests.service.server import Server

pytestmark = pytest.mark.slow
LOST = {"LIPSERVE_REPLICA_BEAT_S": "0.3", "LIPSERVE_REPLICA_LOST_S": "2"}
LONG = {"hyperparameter_samples": 150, "posterior_samples": 60, "max_iterations": 200}


def test_another_service_answers_by_the_model_that_a_killed_one_was_asked_for(shared, tmp_path):
    with cluster(shared, tmp_path / "cluster", "one") as workers:
        env = {**shared.env(), **LOST, "LIPSERVE_CLUSTER": workers.address}
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
