"""Gravity, mass matrix and Coriolis torque by the stream clients."""

import asyncio
import struct

import numpy as np
import pytest

from lipserve import AsyncStreamClient, Client, StreamError
from tests.clients.python.test_stream_client import answer, client_of, error, scripted
from tests.service.data import DEADLINE
from tests.service.streams import MOTION

__all__ = ["scripted"]  # a fixture

Q, DQ, DDQ = MOTION


def part(sequence, flags=256):
    """A frame of one joint with a part that is ten times its sequence."""
    return struct.pack("<IHHIIQdd", sequence, flags, 1, 3, 0, 4, 0.5, 10.0 * sequence)


def test_parts_are_the_components_that_http_returns(streaming):
    names = ["gravity", "inertia_matrix", "coriolis"]
    with Client(streaming.server.url) as client:
        whole = client.predict("pendulum", Q, DQ, DDQ, components=names)

    async def ask():
        async with AsyncStreamClient("pendulum", streaming.server.url, timeout=DEADLINE) as client:
            return [await client.gravity(Q), await client.mass_matrix(Q), await client.coriolis(Q, DQ)]

    with client_of(streaming) as client:
        found = [client.gravity(Q), client.mass_matrix(Q), client.coriolis(Q, DQ)]
        bare, moving, rest = client.gravity(Q, std=False), client.predict(Q, DQ, DDQ), client.predict(Q, DQ, 0 * Q)
    np.testing.assert_allclose(found[1].mean @ DDQ, moving.tau - rest.tau, rtol=1e-9, atol=1e-9)
    for seen in (found, asyncio.run(ask())):
        assert [each.sequence for each in seen] == [1, 2, 3]
        for each, name in zip(seen, names, strict=True):
            assert (each.version, each.revision, each.late) == (1, whole.revision, False)
            np.testing.assert_allclose(each.mean, whole.components[name].mean, rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(seen[0].std, whole.components["gravity"].std, rtol=1e-6)
    assert bare.std is found[1].std is found[2].std is None


def test_late_part_is_the_last_of_its_kind(scripted):
    script = [part(1)], [part(2, 1024)], [], [part(3), answer(4)], [part(5, 512)]
    with scripted(*script) as server, server.client() as client:
        client.gravity([0.5])
        client.coriolis([0.5], [0.1])
        late = client.gravity([0.5], deadline=0.01)
        assert (late.sequence, late.late, late.late_answers, late.mean.tolist()) == (1, True, 1, [10.0])
        assert client.predict([0.25], [0.5], [1.0]).tau.tolist() == [4.0]
        assert client.mass_matrix([0.5]).mean.tolist() == [[50.0]]


def test_answer_of_a_part_that_was_given_up_is_not_received(scripted):
    with scripted([], [part(1), answer(2)]) as server, server.client() as client:
        with pytest.raises(StreamError, match="no answer within"):
            client.gravity([0.5], deadline=0.01)
        client.send([0.25], [0.5], [1.0])
        assert client.receive().sequence == 2


def test_part_that_is_refused_or_of_wrong_shape_is_an_error(scripted):
    with scripted([error(1)], [part(2)]) as server, server.client() as client:
        with pytest.raises(StreamError, match="no"):
            client.gravity([0.5])
        for call, message in (
            (lambda: client.mass_matrix([[0.5]]), r"q has the shape \(1, 1\), expected \(n,\)$"),
            (
                lambda: client.coriolis([0.5], [0.1, 0.2]),
                r"q and dq have the shapes \(1,\), \(2,\), expected \(n,\) each",
            ),
        ):
            with pytest.raises(ValueError, match=message):
                call()
        assert client.gravity([0.5]).mean.tolist() == [20.0]
