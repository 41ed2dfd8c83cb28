"""Torque streams of a real server: answers, their order, addresses, the echo, and new versions."""

import json

import numpy as np
import pytest
from websockets.exceptions import InvalidStatus

from lipserve import StreamClient
from tests.service.data import DEADLINE, ended, eventually, queue, stream, train, upload
from tests.service.streams import (
    MOTION,
    STD,
    STREAM,
    frame,
    motions,
    open_stream,
    read,
    read_hello,
    saved_model,
    send_frame,
)

ECHO = "/v1/echo/stream"


def assert_agrees(answer, model, motion, std=True):
    """Check an answer against the same model in this process."""
    tau, tau_std = model.answer(motion)
    np.testing.assert_allclose(answer.tau, tau, rtol=1e-12, atol=1e-12)
    if std:
        np.testing.assert_allclose(answer.std, tau_std, rtol=1e-12, atol=1e-12)
    else:
        assert answer.std is None


def refusal(server, path=STREAM, **options):
    """Return status and error of a stream that is not opened."""
    with pytest.raises(InvalidStatus) as refused, open_stream(server, path, **options):
        pass
    body = json.loads(refused.value.response.body)
    assert set(body) == {"error"}
    return refused.value.response.status_code, body["error"]


def test_hello_describes_the_answers(streaming):
    with open_stream(streaming.server) as connection:
        reply = read_hello(connection)
    noise = reply.pop("noise_std")
    served = {"model": "pendulum", "version": 1, "revision": 0, "joint_names": list(streaming.model.joint_names)}
    assert reply == served | {"layout": 1, "torque_convention": "gravity_included", "max_position": 12.6}
    np.testing.assert_allclose(noise, streaming.model.noise_std, rtol=1e-12)


@pytest.mark.parametrize(("query", "flags", "std"), [("", STD, True), ("", 0, False), ("?std=1", 0, True)])
def test_answers_equal_those_of_the_model(streaming, query, flags, std):
    with open_stream(streaming.server, STREAM + query) as connection:
        read_hello(connection)
        for number, motion in enumerate(motions(20)):
            answer = send_frame(connection, frame(motion, number, flags))
            assert_agrees(answer, streaming.model, motion, std)
            assert (answer.sequence, answer.flags, answer.version, answer.revision) == (number, STD * std, 1, 0)


def test_frames_sent_ahead_are_answered_in_order(streaming):
    queries = motions(200, seed=1)
    with open_stream(streaming.server) as connection:
        read_hello(connection)
        for number, motion in enumerate(queries):
            connection.send(frame(motion, 2**32 - 200 + number))
        answers = [read(connection.recv(DEADLINE)) for _ in queries]
    assert [answer.sequence for answer in answers] == list(range(2**32 - 200, 2**32))
    for answer, motion in zip(answers, queries, strict=True):
        assert_agrees(answer, streaming.model, motion)


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
        (f"{STREAM}?verison=1", 422, "Unknown stream parameter `verison`. Parameters: version, alias"),
        (f"{STREAM}?min_revision=2147483648", 422, "expected a revision of the version"),
        (f"{STREAM}?stream_id=-arm", 422, "stream_id is -arm, expected a name that matches [A-Za-z0-9]"),
    ],
)
def test_wrong_address_gets_an_http_error(streaming, path, status, message):
    answered, problem = refusal(streaming.server, path)
    assert (answered, problem["code"]) == (status, {404: "not_found", 422: "invalid_request"}[status])
    assert message in problem["message"]
    assert problem["detail"]


def test_pages_of_other_sites_are_rejected(streaming):
    own = f"http://127.0.0.1:{streaming.server.port}"
    with open_stream(streaming.server, origin=own) as connection:
        assert read_hello(connection)["version"] == 1
    for origin in ("http://elsewhere.example", "null", "http://[", f"http://127.0.0.1:{streaming.server.port + 1}"):
        status, problem = refusal(streaming.server, origin=origin)
        assert (status, problem["code"]) == (403, "forbidden")


def test_messages_are_not_compressed(streaming):
    with open_stream(streaming.server, compression="deflate") as connection:
        assert connection.protocol.extensions == []
        read_hello(connection)
        assert_agrees(send_frame(connection, frame()), streaming.model, MOTION)


def test_model_without_a_serving_version_is_rejected(streaming):
    train(streaming.server.client, "waiting", streaming.dataset, promotion="ask")
    status, problem = refusal(streaming.server, "/v1/models/waiting/stream")
    assert (status, problem["code"]) == (409, "no_serving_version")
    assert "`lipserve models promote waiting 1`" in problem["message"]


def test_echo_returns_each_message(streaming):
    with open_stream(streaming.server, ECHO) as connection:
        for message in (frame(), b"", "text"):
            connection.send(message)
            assert connection.recv(DEADLINE) == (message.encode() if isinstance(message, str) else message)


@pytest.mark.slow
def test_streams_follow_the_serving_version_unless_pinned(streaming):
    server, api = streaming.server, streaming.server.client
    train(api, "swapped", streaming.dataset)
    other = upload(api, stream(seed=3, viscous=2.0))["id"]
    queries, answers = motions(50, seed=4), []
    with (
        open_stream(server, "/v1/models/swapped/stream?version=1") as pinned,
        StreamClient("swapped", server.url) as client,
    ):
        assert read_hello(pinned)["version"] == client.hello.version == 1
        job = queue(api, "swapped", other)["id"]

        def swapped():
            for motion in queries:
                answers.append((client.predict(*motion), motion))
            return answers[-1][0].version == 2

        eventually(swapped)
        assert client.hello.version == 2
        assert ended(api, job)["state"] == "succeeded"
        still = send_frame(pinned, frame(queries[0]))

    models = {version: saved_model(server, "swapped", version) for version in (1, 2)}
    assert np.abs(models[1].answer(queries[0])[0] - models[2].answer(queries[0])[0]).max() > 1e-3
    for answer, motion in answers:
        tau, std = models[answer.version].answer(motion)
        np.testing.assert_allclose([answer.tau, answer.tau_std], [tau, std], rtol=1e-12, atol=1e-12)
    versions = [answer.version for answer, _ in answers]
    assert versions == sorted(versions)
    assert set(versions) == {1, 2}
    assert [answer.sequence for answer, _ in answers] == list(range(1, len(answers) + 1))
    assert still.version == 1
    assert_agrees(still, models[1], queries[0])
