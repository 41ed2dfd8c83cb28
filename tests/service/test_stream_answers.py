"""Torque streams of a real server: the numbers, their order, deadlines, the address, and the floor."""

from __future__ import annotations

import json

import numpy as np
import pytest
from websockets.exceptions import InvalidStatus

from tests.service.data import DEADLINE
from tests.service.streams import LATE, MOTION, STD, STREAM, ask, dial, frame, hello, motions, read

ECHO = "/v1/echo/stream"


def agrees(answer, model, motion, std=True):
    """Check an answer against the model's own in this process."""
    tau, tau_std = model.answer(motion)
    np.testing.assert_allclose(answer.tau, tau, rtol=1e-12, atol=1e-12)
    if std:
        np.testing.assert_allclose(answer.std, tau_std, rtol=1e-12, atol=1e-12)
    else:
        assert answer.std is None


def test_hello_says_what_holds_for_all_answers(streaming):
    with dial(streaming.server) as connection:
        said = hello(connection)
    noise = said.pop("noise_std")
    assert said == {
        "layout": 1,
        "model": "pendulum",
        "version": 1,
        "revision": 0,
        "joint_names": list(streaming.model.joint_names),
        "torque_convention": "gravity_included",
        "max_position": 12.6,
    }
    np.testing.assert_allclose(noise, streaming.model.noise_std, rtol=1e-12)


@pytest.mark.parametrize(("query", "flags", "std"), [("", STD, True), ("", 0, False), ("?std=1", 0, True)])
def test_answers_are_those_of_the_model(streaming, query, flags, std):
    with dial(streaming.server, STREAM + query) as connection:
        hello(connection)
        for number, motion in enumerate(motions(20)):
            answer = ask(connection, frame(motion, number, flags))
            agrees(answer, streaming.model, motion, std)
            assert (answer.sequence, answer.flags, answer.version, answer.revision) == (number, STD * std, 1, 0)


def test_a_stream_answers_what_http_answers(streaming):
    q, dq, ddq = MOTION.tolist()
    answer = streaming.server.client.post("/v1/models/pendulum/predict", json={"q": q, "dq": dq, "ddq": ddq}).json()
    with dial(streaming.server) as connection:
        hello(connection)
        streamed = ask(connection, frame())
    np.testing.assert_allclose(streamed.tau, answer["tau"], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(streamed.std, answer["tau_std"], rtol=1e-9, atol=1e-9)


def test_frames_sent_ahead_are_answered_one_by_one_in_order(streaming):
    queries = motions(200, seed=1)
    with dial(streaming.server) as connection:
        hello(connection)
        for number, motion in enumerate(queries):
            connection.send(frame(motion, 2**32 - 200 + number))
        answers = [read(connection.recv(DEADLINE)) for _ in queries]
    assert [answer.sequence for answer in answers] == list(range(2**32 - 200, 2**32))
    for answer, motion in zip(answers, queries, strict=True):
        agrees(answer, streaming.model, motion)


def test_a_message_in_fragments_is_one_frame(streaming):
    whole = frame()
    with dial(streaming.server) as connection:
        hello(connection)
        connection.send([whole[:7], whole[7:40], whole[40:]])
        agrees(read(connection.recv(DEADLINE)), streaming.model, MOTION)


def test_missed_deadlines_are_flagged_and_counted(streaming):
    with dial(streaming.server) as connection, dial(streaming.server) as other:
        hello(connection), hello(other)
        seen = [ask(connection, frame(budget=budget)) for budget in (60.0, 1e-9, 0.0, 1e-9, 60.0)]
        assert [bool(answer.flags & LATE) for answer in seen] == [False, True, False, True, False]
        assert [answer.late for answer in seen] == [0, 1, 1, 2, 2]
        agrees(seen[1], streaming.model, MOTION)
        assert ask(other, frame()).late == 0


@pytest.mark.parametrize(
    ("path", "status", "message"),
    [
        ("/v1/models/Nobody%20%C3%B6/stream", 404, "no model 'Nobody ö'"),
        (f"{STREAM}?version=7", 404, "no version '7'"),
        (f"{STREAM}?version=0", 422, "version is 0, expected the number of a version"),
        (f"{STREAM}?version=9999999999", 422, "version is 9999999999, expected the number"),
        (f"{STREAM}?version={'9' * 5000}", 422, "expected the number of a version"),
        (f"{STREAM}?version=%D9%A1", 422, "expected the number of a version"),
        (f"{STREAM}?std=yes", 422, "std is yes, expected 0 or 1"),
        (f"{STREAM}?verison=1", 422, "verison is 1, expected no parameter but version, alias"),
        (f"{STREAM}?min_revision=2147483648", 422, "expected a revision of the version"),
        (f"{STREAM}?stream_id=-arm", 422, "stream_id is -arm, expected a name that matches [A-Za-z0-9]"),
    ],
)
def test_a_wrong_address_is_refused_in_http(streaming, path, status, message):
    with pytest.raises(InvalidStatus) as refused, dial(streaming.server, path):
        pass
    response = refused.value.response
    assert response.status_code == status
    body = json.loads(response.body)
    assert set(body) == {"error"}
    assert body["error"]["code"] == {404: "not_found", 422: "invalid_request"}[status]
    assert message in body["error"]["message"]
    assert body["error"]["detail"]


def test_refusals_are_no_errors_of_the_server(streaming):
    with pytest.raises(InvalidStatus), dial(streaming.server, "/v1/models/nobody/stream"):
        pass
    with dial(streaming.server) as connection:  # by then, what there is to log of the refusal is logged
        hello(connection)
    assert "ERROR" not in streaming.server.log.read_text()


def test_web_pages_of_other_sites_are_refused(streaming):
    own = f"http://127.0.0.1:{streaming.server.port}"
    with dial(streaming.server, origin=own) as connection:
        assert hello(connection)["version"] == 1
    for origin in ("http://elsewhere.example", "null", "http://[", f"http://127.0.0.1:{streaming.server.port + 1}"):
        with pytest.raises(InvalidStatus) as refused, dial(streaming.server, origin=origin):
            pass
        assert refused.value.response.status_code == 403
        assert json.loads(refused.value.response.body)["error"]["code"] == "forbidden"


def test_nothing_is_compressed(streaming):
    with dial(streaming.server, compression="deflate") as connection:
        assert connection.protocol.extensions == []
        hello(connection)
        agrees(ask(connection, frame()), streaming.model, MOTION)


def test_the_echo_sends_back_what_comes(streaming):
    with dial(streaming.server, ECHO) as connection:
        for message in (frame(), b"", "text"):
            connection.send(message)
            assert connection.recv(DEADLINE) == (message.encode() if isinstance(message, str) else message)
