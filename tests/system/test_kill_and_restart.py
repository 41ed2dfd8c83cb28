"""A server that is killed during a training or a stream continues after a restart as if nothing had happened."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lipcore.online.batch import Rows
from service.cli.verify import verify_home
from service.foundation.settings import Settings
from service.storage.database import Database
from service.storage.files import Files
from tests.service.data import ENDLESS, ended, eventually, queue, running, stream, train, upload
from tests.service.learning.learning_models import DEFAULT_OPTIONS, LearningModel, max_difference, publish
from tests.service.server import Server, command
from tests.system import remembering

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
        assert verify_home(Settings(home=home)).damages == []
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


STEPS = (0, 1, 2, 3, 4, "kill", 4, 5, 6, "undo", "kill", 6, 7, 8, 9)
"""Batches of a stream, the undo of one of them, and kills right after an acknowledgement. The last batch before a kill
is sent again, as by a client that waits for an answer."""


@dataclass
class Stream:
    """What a server has logged and learnt after a stream."""

    logged: Sequence[Rows]
    answer: dict[str, Any]


def send_stream(home: Path, kills: bool) -> Stream:
    """Take the steps of a stream, with or without kills."""
    settings = Settings(home=home)
    database, trained = Database.of(settings), remembering.save_model(home.with_name(home.name + "-model"))
    publish(database, Files.of(settings), trained, remembering.MODEL)
    with ExitStack() as running:
        server = running.enter_context(Server(home))
        model, revision = LearningModel(server.client, remembering.MODEL), 0
        model.put("learning", DEFAULT_OPTIONS)
        for step in STEPS:
            if step == "kill":
                if kills:
                    server.kill()
                    server = running.enter_context(Server(home))
                    model = LearningModel(server.client, remembering.MODEL)
                continue
            model.wait_for_revision(revision)  # it judges the next batch, so that all servers judge alike
            if step == "undo":
                last = model.delete(f"observations/{remembering.STREAM}/{remembering.UNLEARNT}")
            else:
                last = model.post("observations", remembering.stream_batch(int(step)))
            revision = max(revision, last["revision"])  # a batch sent again has the revision of its first time
        model.wait_for_revision(revision)
        answer = model.predict(remembering.query_along())
        assert verify_home(settings).damages == []
    logged = remembering.read_stream(database)
    database.close()
    return Stream(logged, answer)


@pytest.fixture(scope="module")
def streams(tmp_path_factory) -> list[Stream]:
    """A stream to a server that is never killed, and to one that is killed twice."""
    folder = tmp_path_factory.mktemp("streams")
    return [send_stream(folder / f"kills-{kills}", kills) for kills in (False, True)]


def test_killed_server_follows_the_motion_of_its_stream(streams):
    undisturbed, killed = (Rows.concatenate(each.logged) for each in streams)
    np.testing.assert_array_equal(killed.code, undisturbed.code)
    np.testing.assert_allclose(killed.weight, undisturbed.weight, rtol=1e-9)
    np.testing.assert_allclose(np.diff(killed.time), np.diff(undisturbed.time), atol=1e-6)
    remembering.assert_deflections_known(streams[1].logged)


def test_killed_server_learns_the_log_without_the_unlearnt_batch(streams):
    undisturbed, killed = streams
    assert max_difference(killed.answer, undisturbed.answer) < remembering.TOLERANCE_NM
    for without, equal in ((remembering.UNLEARNT, True), (None, False)):
        expected = remembering.predict_learnt(killed.logged, without)
        assert (np.abs(killed.answer["tau"] - expected).max() < remembering.TOLERANCE_NM) == equal
