"""A server that is killed during a training continues after a restart as if nothing had happened."""

from dataclasses import dataclass
from typing import Any

import pytest

from tests.service.data import ENDLESS, ended, eventually, queue, running, stream, train, upload
from tests.service.server import Server, command

QUERY = {"q": [0.3, -0.2], "dq": [0.1, 0.4], "ddq": [1.0, -0.5], "covariance": True}
LONG = {**ENDLESS, "hyperparameter_samples": 60, "max_iterations": 25}
"""A fit that takes a few seconds."""


@dataclass
class KillAndRestart:
    """Observations before the kill and after the restart."""

    answer_before: dict[str, Any]
    answer_after: dict[str, Any]
    orphans: list[int]
    at_the_kill: dict[str, Any]
    at_the_end: dict[str, Any]
    model: dict[str, Any]
    versions_on_disk: int
    log: str


@pytest.fixture(scope="module")
def outcome(tmp_path_factory):
    home = tmp_path_factory.mktemp("killed")
    with Server(home) as server:
        train(server.client, "pendulum", upload(server.client, stream())["id"])
        before = server.client.post("/v1/models/pendulum/predict", json=QUERY).json()
        name = queue(server.client, "panda", upload(server.client, stream("panda", 150))["id"], options=LONG)["id"]
        at_the_kill = running(server.client, name)
        orphans = server.started()
        server.kill()
    with Server(home) as server:
        after = server.client.post("/v1/models/pendulum/predict", json=QUERY).json()
        at_the_end = ended(server.client, name)
        return KillAndRestart(
            before,
            after,
            orphans,
            at_the_kill,
            at_the_end,
            server.client.get("/v1/models/panda").json(),
            len(list((home / "versions").iterdir())),
            server.log.read_text(),
        )


def test_training_processes_end_with_server(outcome):
    assert len(outcome.orphans) == 2  # and the weigher process
    eventually(lambda: all(command(pid) == "" for pid in outcome.orphans))


def test_prediction_is_identical_after_restart(outcome):
    assert len(outcome.answer_before["tau"]) == 2
    assert outcome.answer_after == outcome.answer_before


def test_interrupted_job_is_restarted_and_succeeds(outcome):
    assert (outcome.at_the_kill["state"], outcome.at_the_kill["attempts"]) == ("running", 1)
    assert (outcome.at_the_end["state"], outcome.at_the_end["attempts"]) == ("succeeded", 2)
    assert f"queued again after an interruption: {outcome.at_the_end['id']}" in outcome.log


def test_job_publishes_one_version(outcome):
    assert outcome.at_the_end["version"] == 1
    assert [version["version"] for version in outcome.model["versions"]] == [1]
    assert outcome.versions_on_disk == 3  # panda-sim, pendulum, panda
