"""A server process that is killed outright, while it trains: after a restart it is as if nothing had happened."""

from dataclasses import dataclass
from typing import Any

import pytest

from tests.service.data import ENDLESS, ended, eventually, queue, running, stream, train, upload
from tests.service.server import Server, command

pytestmark = pytest.mark.slow
QUERY = {"q": [0.3, -0.2], "dq": [0.1, 0.4], "ddq": [1.0, -0.5], "covariance": True}
LONG = {**ENDLESS, "hyperparameter_samples": 60, "max_iterations": 25}
"""A fit of a few seconds."""


@dataclass
class Story:
    """What was seen before the kill and after the restart."""

    answer_before: dict[str, Any]
    answer_after: dict[str, Any]
    orphans: list[int]
    at_the_kill: dict[str, Any]
    at_the_end: dict[str, Any]
    model: dict[str, Any]
    versions_on_disk: int
    log: str


@pytest.fixture(scope="module")
def story(tmp_path_factory):
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
        return Story(
            before,
            after,
            orphans,
            at_the_kill,
            at_the_end,
            server.client.get("/v1/models/panda").json(),
            len(list((home / "versions").iterdir())),
            server.log.read_text(),
        )


def test_training_processes_end_with_the_server(story):
    assert len(story.orphans) == 2  # and the one that weighs
    eventually(lambda: all(command(pid) == "" for pid in story.orphans))


def test_the_same_query_has_the_identical_answer(story):
    assert len(story.answer_before["tau"]) == 2
    assert story.answer_after == story.answer_before


def test_the_interrupted_job_is_started_again_and_succeeds(story):
    assert (story.at_the_kill["state"], story.at_the_kill["attempts"]) == ("running", 1)
    assert (story.at_the_end["state"], story.at_the_end["attempts"]) == ("succeeded", 2)
    assert f"queued again after an interruption: {story.at_the_end['id']}" in story.log


def test_exactly_one_version_is_made(story):
    assert story.at_the_end["version"] == 1
    assert [version["version"] for version in story.model["versions"]] == [1]
    assert story.versions_on_disk == 3  # panda-sim, pendulum, panda
