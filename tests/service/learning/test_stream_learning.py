"""Torque sent over WebSockets to a real server: acknowledged when durable, and learnt once."""

import json
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from sqlalchemy import text

from lipcore.online.batch import Rows
from lipcore.online.learner import OnlineModel
from lipserve import StreamClient, StreamError
from service.foundation.settings import Settings
from service.storage.database import Database
from tests.service.data import DEADLINE, eventually, stream, train, upload
from tests.service.server import Server
from tests.service.streams import STREAM, frame, logged_batches, logged_rows, open_stream, read, read_hello, saved_model


@dataclass(frozen=True)
class MeasuredMotions:
    """Distinct motions (N, 3, n) and their measured torques (N, n)."""

    motions: np.ndarray
    tau: np.ndarray


def make_measurements(robot: str, count: int) -> MeasuredMotions:
    """Return a recording of a robot that no model was trained on."""
    samples = stream(robot, samples=count, seed=11)
    return MeasuredMotions(np.stack([samples.q, samples.dq, samples.ddq], 1), samples.tau)


@pytest.fixture(scope="module")
def measured() -> MeasuredMotions:
    return make_measurements("double-pendulum", 500)


@pytest.fixture(scope="module")
def learning_server(tmp_path_factory):
    """Server with a short flush interval."""
    with Server(tmp_path_factory.mktemp("learning"), warm=True, LIPSERVE_STREAM_FLUSH_S="0.05") as server:
        train(server.client, "pendulum", upload(server.client, stream())["id"])
        yield server


def open_client(server: Server, stream_id: str, model: str = "pendulum", **options: Any) -> StreamClient:
    return StreamClient(model, server.url, timeout=DEADLINE, stream_id=stream_id, **options)


def assert_sent_once(found: Rows, measured: MeasuredMotions, indices: list[int]) -> None:
    """Check that the rows are these samples, each once and in order."""
    np.testing.assert_array_equal(np.stack([found.q, found.dq, found.ddq], 1), measured.motions[indices])
    np.testing.assert_array_equal(found.tau, measured.tau[indices])


@pytest.mark.slow
def test_measured_torque_is_learnt_while_predicting(learning_server, measured):
    count, unseen = 400, measured.motions[400:]
    with open_client(learning_server, "arm-1") as client:
        answers = [client.predict(*measured.motions[k], tau=measured.tau[k]) for k in range(count)]
        learnt = client.flush()
        eventually(lambda: client.predict(*unseen[0]).revision >= learnt.revision)
        after = [client.predict(*motion) for motion in unseen]
    assert (learnt.through, learnt.duplicates, client.refusals) == (count, 0, ())
    assert learnt.accepted + sum(learnt.rejected.values()) == count
    assert learnt.accepted > count // 2
    assert answers[0].revision == 0 < learnt.revision
    found = logged_rows(learning_server, "arm-1")
    assert_sent_once(found, measured, list(range(count)))
    assert (np.diff(found.time) > 0).all()
    # the logged revision of a row is the one that predicted it
    revisions = [event.revision for event in logged_batches(learning_server, "arm-1") for _ in range(event.rows)]
    assert revisions == [answer.revision for answer in answers]
    trained = saved_model(learning_server, "pendulum", 1)
    model = OnlineModel.start(trained).learn(found).model()
    assert {answer.revision for answer in after} == {learnt.revision}
    answered = np.array([answer.tau for answer in after])
    np.testing.assert_allclose(answered, [model.answer(each)[0] for each in unseen], rtol=1e-6)
    # faster rows have less weight, so the change depends on the machine; it exceeds rounding
    before = np.array([trained.answer(each)[0] for each in unseen])
    assert np.abs(answered / before - 1).max() > 1e-5


@pytest.mark.slow
def test_frames_are_acknowledged_only_after_commit(learning_server, measured):
    database = Database.of(Settings(home=learning_server.home))
    with open_stream(learning_server, f"{STREAM}?stream_id=locked") as connection:
        read_hello(connection)
        with database.transaction() as session:  # blocks all other writers
            assert session.execute(text("SELECT count(*) FROM events WHERE stream_id = 'locked'")).scalar() == 0
            for number in range(5):
                connection.send(frame(measured.motions[number], number, tau=measured.tau[number]))
            assert [read(connection.recv(DEADLINE)).sequence for _ in range(5)] == list(range(5))
            with pytest.raises(TimeoutError):
                connection.recv(0.5)
        through = -1
        while through < 4:
            through = json.loads(connection.recv(DEADLINE))["learnt"]["through"]
            assert logged_batches(learning_server, "locked")[-1].last_sequence >= through
    database.close()
    assert_sent_once(logged_rows(learning_server, "locked"), measured, list(range(5)))


@pytest.mark.slow
def test_kill_loses_and_duplicates_no_acknowledged_frame(home):
    measured, acknowledged, count = make_measurements("panda", 800), 0, 800
    for kill_at in (90, 333, 600, None):  # None: no kill
        with Server(home, LIPSERVE_STREAM_FLUSH_S="0.02", LIPSERVE_STREAM_FLUSH_ROWS="20") as server:
            with open_client(server, "killed", "panda-sim", first_sequence=acknowledged + 1) as client:
                for k in range(acknowledged, count if kill_at is None else kill_at):
                    client.predict(*measured.motions[k], tau=measured.tau[k])
                    if k % 80 == 79:
                        client.flush()
                if kill_at is None:
                    assert client.flush().through == count
                else:
                    for k in range(kill_at, kill_at + 45):  # in transit at the kill
                        client.send(*measured.motions[k], tau=measured.tau[k])
                    server.kill()
                    with suppress(StreamError):
                        client.flush()
                assert client.refusals == ()
                acknowledged = client.learnt.through
            durable = logged_rows(server, "killed")
            assert len(durable) >= acknowledged > 0
            assert_sent_once(durable, measured, list(range(len(durable))))
    assert acknowledged == len(durable) == count
