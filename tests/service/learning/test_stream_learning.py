"""Torque over WebSockets into the log of a real server: acknowledged when it is durable, learnt once, whatever dies."""

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
from tests.service.streams import STREAM, batches, dial, frame, hello, read, rows, saved_model


@dataclass(frozen=True)
class Measured:
    """Motions (N, 3, n) and the torques (N, n) measured at them, no two alike."""

    motions: np.ndarray
    tau: np.ndarray


def measured_on(robot: str, count: int) -> Measured:
    """A recording of a robot that no model was trained on."""
    samples = stream(robot, samples=count, seed=11)
    return Measured(np.stack([samples.q, samples.dq, samples.ddq], 1), samples.tau)


@pytest.fixture(scope="module")
def measured() -> Measured:
    return measured_on("double-pendulum", 500)


@pytest.fixture(scope="module")
def learning(tmp_path_factory):
    """A server that logs frames soon."""
    with Server(tmp_path_factory.mktemp("learning"), warm=True, LIPSERVE_STREAM_FLUSH_S="0.05") as server:
        train(server.client, "pendulum", upload(server.client, stream())["id"])
        yield server


def client_of(server: Server, stream_id: str, model: str = "pendulum", **options: Any) -> StreamClient:
    return StreamClient(model, server.url, timeout=DEADLINE, stream_id=stream_id, **options)


def sent_once(found: Rows, measured: Measured, indices: list[int]) -> None:
    """Check that the rows are these samples, each once and in order."""
    np.testing.assert_array_equal(np.stack([found.q, found.dq, found.ddq], 1), measured.motions[indices])
    np.testing.assert_array_equal(found.tau, measured.tau[indices])


def test_what_a_controller_measures_is_learnt_while_it_asks(learning, measured):
    count, unseen = 400, measured.motions[400:]
    with client_of(learning, "arm-1") as client:
        answers = [client.predict(*measured.motions[k], tau=measured.tau[k]) for k in range(count)]
        learnt = client.flush()
        eventually(lambda: client.predict(*unseen[0]).revision >= learnt.revision)
        after = [client.predict(*motion) for motion in unseen]
    assert (learnt.through, learnt.duplicates, client.refusals) == (count, 0, ())
    assert learnt.accepted + sum(learnt.rejected.values()) == count
    assert learnt.accepted > count // 2
    assert answers[0].revision == 0 < learnt.revision
    found = rows(learning, "arm-1")
    sent_once(found, measured, list(range(count)))
    assert (np.diff(found.time) > 0).all()
    # what is on record of a row is what was answered before it was learnt
    revisions = [event.revision for event in batches(learning, "arm-1") for _ in range(event.rows)]
    assert revisions == [answer.revision for answer in answers]
    trained = saved_model(learning, "pendulum", 1)
    model = OnlineModel.start(trained).learn(found).model()
    assert {answer.revision for answer in after} == {learnt.revision}
    answered = np.array([answer.tau for answer in after])
    np.testing.assert_allclose(answered, [model.answer(each)[0] for each in unseen], rtol=1e-6)
    # rows that come faster teach less, as they say the same again: how much is the machine's, more than rounding is not
    before = np.array([trained.answer(each)[0] for each in unseen])
    assert np.abs(answered / before - 1).max() > 1e-5


def test_nothing_is_acknowledged_before_it_is_in_the_database(learning, measured):
    database = Database.of(Settings(home=learning.home))
    with dial(learning, f"{STREAM}?stream_id=locked") as connection:
        hello(connection)
        with database.transaction() as session:  # nobody else can write
            assert session.execute(text("SELECT count(*) FROM events WHERE stream_id = 'locked'")).scalar() == 0
            for number in range(5):
                connection.send(frame(measured.motions[number], number, tau=measured.tau[number]))
            assert [read(connection.recv(DEADLINE)).sequence for _ in range(5)] == list(range(5))
            with pytest.raises(TimeoutError):
                connection.recv(0.5)
        through = -1
        while through < 4:
            through = json.loads(connection.recv(DEADLINE))["learnt"]["through"]
            assert batches(learning, "locked")[-1].last_sequence >= through
    database.close()
    sent_once(rows(learning, "locked"), measured, list(range(5)))


@pytest.mark.slow
def test_no_acknowledged_frame_is_lost_or_learnt_twice_when_the_service_is_killed(home):
    measured, known, count = measured_on("panda", 800), 0, 800
    for kill_at in (90, 333, 600, None):  # None: to the end
        with Server(home, LIPSERVE_STREAM_FLUSH_S="0.02", LIPSERVE_STREAM_FLUSH_ROWS="20") as server:
            with client_of(server, "killed", "panda-sim", first_sequence=known + 1) as client:
                for k in range(known, count if kill_at is None else kill_at):
                    client.predict(*measured.motions[k], tau=measured.tau[k])
                    if k % 80 == 79:
                        client.flush()
                if kill_at is None:
                    assert client.flush().through == count
                else:
                    for k in range(kill_at, kill_at + 45):  # under way when it dies
                        client.send(*measured.motions[k], tau=measured.tau[k])
                    server.kill()
                    with suppress(StreamError):
                        client.flush()
                assert client.refusals == ()
                known = client.learnt.through
            durable = rows(server, "killed")
            assert len(durable) >= known > 0
            sent_once(durable, measured, list(range(len(durable))))
    assert known == len(durable) == count
