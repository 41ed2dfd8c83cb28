"""A new version is trained while torques stream: no answer is dropped, late for it, or half of each."""

from __future__ import annotations

import numpy as np

from service.client.stream import StreamClient
from tests.service.data import DEADLINE, ended, eventually, queue, stream, train, upload
from tests.service.streams import ask, dial, frame, hello, motions, read, saved_model


def same(found, expected):
    """Check a torque and its standard deviation against those of a model."""
    for values, wanted in zip(found, expected, strict=True):
        np.testing.assert_allclose(values, wanted, rtol=1e-12, atol=1e-12)


def test_streams_follow_the_newest_version_and_pinned_ones_stay(streaming):
    server, api = streaming.server, streaming.server.client
    train(api, "swapped", streaming.dataset)
    other = upload(api, stream(seed=3, viscous=2.0))["id"]
    queries, answers = motions(50, seed=4), []
    with dial(server, "/v1/models/swapped/stream?version=1") as pinned, StreamClient("swapped", server.url) as client:
        assert hello(pinned)["version"] == client.hello.version == 1
        job = queue(api, "swapped", other)["id"]

        def swapped():
            for motion in queries:
                answers.append((client.ask(*motion), motion))
            return answers[-1][0].version == 2

        eventually(swapped)
        assert client.hello.version == 2
        assert ended(api, job)["state"] == "succeeded"
        still = ask(pinned, frame(queries[0]))

    models = {version: saved_model(server, "swapped", version) for version in (1, 2)}
    assert np.abs(models[1].answer(queries[0])[0] - models[2].answer(queries[0])[0]).max() > 1e-3
    for answer, motion in answers:
        same((answer.tau, answer.tau_std), models[answer.version].answer(motion))
    versions = [answer.version for answer, _ in answers]
    assert versions == sorted(versions)
    assert set(versions) == {1, 2}
    assert [answer.sequence for answer, _ in answers] == list(range(1, len(answers) + 1))
    assert still.version == 1
    same((still.tau, still.std), models[1].answer(queries[0]))


def test_frames_sent_ahead_of_a_swap_are_all_answered(streaming):
    server, api = streaming.server, streaming.server.client
    train(api, "ahead", streaming.dataset)
    job = queue(api, "ahead", streaming.dataset)["id"]
    queries, answers, hellos = motions(20, seed=5), [], []
    with dial(server, "/v1/models/ahead/stream") as connection:

        def swapped():
            for number, motion in enumerate(queries):
                connection.send(frame(motion, number))
            block = []
            while len(block) < len(queries):
                data = connection.recv(DEADLINE)
                if isinstance(data, str):
                    hellos.append(data)
                else:
                    block.append(read(data))
            answers.append(block)
            return block[-1].version == 2

        eventually(swapped)
    ended(api, job)
    models = {version: saved_model(server, "ahead", version) for version in (1, 2)}
    for block in answers:
        assert [answer.sequence for answer in block] == list(range(len(queries)))
        for answer, motion in zip(block, queries, strict=True):
            same((answer.tau, answer.std), models[answer.version].answer(motion))
    assert len(hellos) == 2
