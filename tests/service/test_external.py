"""External torque of a real server, by WebSocket and /v2: from what the same server says of the motion over HTTP."""

import asyncio

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from lipserve import AsyncClient, StreamClient, StreamError
from tests.service.data import DEADLINE
from tests.service.oip import ask as infer
from tests.service.oip import message, path_of, refused, tensors
from tests.service.streams import ASK_EXTERNAL, EXTERNAL, SCALE, STD, STREAM, TAU, ask, dial, frame, hello, motions

JOINTS = "tau_external", "tau_external_std", "tau_external_z"
ARM = "tau_external_statistic", "tau_external_p"
EXACT = {"rtol": 1e-7, "atol": 1e-12}


@pytest.fixture(scope="module")
def measured(streaming):
    """Motions (5, 3, 2), torques near and far from what the model predicts (5, 2), and what is to be said of them, by
    name: computed here from the answer to a plain prediction."""
    queries = motions(5)
    request = dict(zip(("q", "dq", "ddq"), queries.transpose(1, 0, 2).tolist(), strict=True))
    answer = streaming.server.client.post("/v1/models/pendulum/predict", json=request | {"covariance": True}).json()
    mean, std, noise_std, scale, between = (
        np.array(answer[name]) for name in ("tau", "tau_std", "noise_std", "scale", "covariance")
    )
    error = np.array([[0.0, 0.0], [0.01, -0.01], [0.1, 0.0], [0.0, -1.0], [5.0, 5.0]])
    total = np.diag(scale) @ (between + np.diag(noise_std**2)) @ np.diag(scale)
    spread = scale * np.sqrt(std**2 + noise_std**2)
    statistic = np.array([each @ np.linalg.inv(c) @ each for each, c in zip(error, total, strict=True)])
    values = error, spread, error / spread, statistic[:, None], stats.chi2.sf(statistic, 2)[:, None]
    return queries, mean + error, dict(zip(JOINTS + ARM, values, strict=True))


def assert_is(numbers, expected, row):
    """Check the numbers of an answer, (3 n + 2,), in the order that is documented."""
    assert_allclose(numbers, np.concatenate([values[row] for values in expected.values()]), **EXACT)


@pytest.mark.parametrize(
    ("query", "flags", "answered"), [("", 0, 0), ("?std=1", 0, STD), ("?scale=1", STD, STD | SCALE)]
)
def test_frames_that_ask_are_answered_it_after_all_else(streaming, measured, query, flags, answered):
    queries, tau, expected = measured
    with dial(streaming.server, STREAM + query) as connection:
        hello(connection)
        for row, motion in enumerate(queries):
            plain = ask(connection, frame(motion, row, flags))
            compared = ask(connection, frame(motion, row, flags | ASK_EXTERNAL, tau=tau[row], learn=False))
            assert (plain.flags, plain.external, compared.flags) == (answered, None, answered | EXTERNAL)
            for name in ("tau", "std", "scale"):
                if getattr(plain, name) is not None:
                    assert_allclose(getattr(compared, name), getattr(plain, name), rtol=1e-9)
            assert_is(compared.external, expected, row)


def test_a_pinned_stream_is_told_too(streaming, measured):
    queries, tau, expected = measured
    with StreamClient("pendulum", streaming.server.url, version=1, timeout=DEADLINE) as client:
        seen = client.predict(*queries[3], std=False, tau=tau[3], external=True)
    assert (seen.tau_std, seen.scale) == (None, None)
    of = seen.external
    assert_is([*of.tau, *of.std, *of.z, of.statistic, of.p], expected, 3)


def test_clients_compare_and_teach_as_they_are_told(streaming, measured):
    queries, tau, expected = measured

    async def talk():
        async with (
            AsyncClient(streaming.server.url) as client,
            client.stream("pendulum", stream_id="pushed", scale=True, timeout=DEADLINE) as opened,
        ):
            only = await opened.predict(*queries[2], tau=tau[2], external=True, learn=False)
            assert not opened._exchange.unsettled
            taught = await opened.predict(*queries[2], tau=tau[2] * np.nan)
            settled = await opened.flush()
            with pytest.raises(StreamError, match=r"tau\[0\] is nan, expected a finite number"):
                await opened.predict(*queries[2], tau=tau[2] * np.nan, external=True)
            assert (await opened.flush()).through == settled.through  # a refused torque is waited for by nobody
            return only, taught, settled

    only, taught, settled = asyncio.run(talk())
    assert_allclose(only.external.z, expected["tau_external_z"][2], **EXACT)
    assert_allclose(only.external.p, expected["tau_external_p"][2, 0], **EXACT)
    assert only.scale is not None
    assert taught.external is None
    assert (settled.through, settled.accepted) == (taught.sequence, 0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"external": True}, "tau is missing, expected the torque measured"),
        ({"tau": TAU}, "tau is given, expected a client with stream_id, .*, or external"),
        ({"tau": TAU[:1], "external": True}, r"expected \(n,\) each"),
    ],
)
def test_clients_refuse_what_makes_no_sense_before_it_is_sent(streaming, options, message):
    with StreamClient("pendulum", streaming.server.url) as client:
        with pytest.raises(ValueError, match=message):
            client.send(*motions(1)[0], **options)
        assert client.predict(*motions(1)[0]).sequence == 1


@pytest.mark.parametrize("names", [JOINTS, ARM, (*ARM, "tau", "scale", *JOINTS, "tau_gravity")])
@pytest.mark.parametrize("rows", [None, 1, 5])
def test_the_inference_protocol_says_the_same(streaming, measured, names, rows):
    queries, tau, expected = measured
    inputs = dict(zip(("q", "dq", "ddq", "tau"), (*queries.transpose(1, 0, 2), tau), strict=True))
    inputs = {name: values[0] if rows is None else values[:rows] for name, values in inputs.items()}
    result = tensors(infer(streaming.server.client, "pendulum", message(inputs, *names)))
    assert list(result) == list(names)
    for name in set(names) & expected.keys():
        values = expected[name][0] if rows is None else expected[name][:rows]
        assert result[name].shape == values.shape
        assert_allclose(result[name], values, **EXACT)


def test_the_inference_protocol_refuses_what_it_cannot_compare(streaming):
    motion = dict(zip(("q", "dq", "ddq"), motions(1)[0], strict=True))

    def refusal(inputs, *names):
        return refused(streaming.server.client.post(path_of("pendulum"), json=message(motion | inputs, *names)))

    missing = "tau is missing, expected the torque that forward_dynamics or tau_external is asked for"
    assert refusal({}, "tau_external_p").startswith(missing)
    assert refusal({"tau": TAU}).startswith("tau is given, expected no tau, or forward_dynamics or tau_external among")
    assert refusal({"tau": [1.0]}, *JOINTS) == "tau.shape is [1], expected that of q, [2]"
    for name in ("tau_external_z", "tau_external_statistic"):
        assert refusal({"tau": [1e308, 0.0]}, name).startswith(f"{name}[0] is inf, expected a finite number")
