"""External torque of a real server, by WebSocket and /v2, compared with the server's HTTP prediction."""

import asyncio

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from lipserve import AsyncClient, StreamClient, StreamError
from tests.service.api.oip.requests import error_message, infer, infer_path, message, tensors
from tests.service.data import DEADLINE
from tests.service.streams import (
    ASK_EXTERNAL,
    EXTERNAL,
    SCALE,
    STD,
    STREAM,
    TAU,
    frame,
    motions,
    open_stream,
    read_hello,
    send_frame,
)

JOINTS = "tau_external", "tau_external_std", "tau_external_z"
ARM = "tau_external_statistic", "tau_external_p"
EXACT = {"rtol": 1e-7, "atol": 1e-12}


@pytest.fixture(scope="module")
def measured(streaming):
    """Motions (5, 3, 2), torques (5, 2) near and far from the prediction, and the expected values by name, computed
    here from a plain prediction."""
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


def assert_external(numbers, expected, row):
    """Check the numbers of an answer, (3 n + 2,), in the documented order."""
    assert_allclose(numbers, np.concatenate([values[row] for values in expected.values()]), **EXACT)


@pytest.mark.parametrize(
    ("query", "flags", "answered"), [("", 0, 0), ("?std=1", 0, STD), ("?scale=1", STD, STD | SCALE)]
)
def test_external_torque_follows_the_other_values_of_an_answer(streaming, measured, query, flags, answered):
    queries, tau, expected = measured
    with open_stream(streaming.server, STREAM + query) as connection:
        read_hello(connection)
        for row, motion in enumerate(queries):
            plain = send_frame(connection, frame(motion, row, flags))
            compared = send_frame(connection, frame(motion, row, flags | ASK_EXTERNAL, tau=tau[row], learn=False))
            assert (plain.flags, plain.external, compared.flags) == (answered, None, answered | EXTERNAL)
            for name in ("tau", "std", "scale"):
                if getattr(plain, name) is not None:
                    assert_allclose(getattr(compared, name), getattr(plain, name), rtol=1e-9)
            assert_external(compared.external, expected, row)


def test_pinned_stream_answers_external_torque(streaming, measured):
    queries, tau, expected = measured
    with StreamClient("pendulum", streaming.server.url, version=1, timeout=DEADLINE) as client:
        seen = client.predict(*queries[3], std=False, tau=tau[3], external=True)
    assert (seen.tau_std, seen.scale) == (None, None)
    of = seen.external
    assert_external([*of.tau, *of.std, *of.z, of.statistic, of.p], expected, 3)


def test_clients_compare_and_learn_as_requested(streaming, measured):
    queries, tau, expected = measured

    async def use_clients():
        async with (
            AsyncClient(streaming.server.url) as client,
            client.stream("pendulum", stream_id="pushed", scale=True, timeout=DEADLINE) as opened,
        ):
            only = await opened.predict(*queries[2], tau=tau[2], external=True, learn=False)
            assert not opened._exchange.unsettled
            answer = await opened.predict(*queries[2], tau=tau[2] * np.nan)
            settled = await opened.flush()
            with pytest.raises(StreamError, match=r"tau\[0\] is nan, expected a finite number"):
                await opened.predict(*queries[2], tau=tau[2] * np.nan, external=True)
            assert (await opened.flush()).through == settled.through  # no client waits for a rejected torque
            return only, answer, settled

    only, answer, settled = asyncio.run(use_clients())
    assert_allclose(only.external.z, expected["tau_external_z"][2], **EXACT)
    assert_allclose(only.external.p, expected["tau_external_p"][2, 0], **EXACT)
    assert only.scale is not None
    assert answer.external is None
    assert (settled.through, settled.accepted) == (answer.sequence, 0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"external": True}, "`external` requires `tau`"),
        ({"tau": TAU}, "`tau` has no effect: .* set `stream_id` of the client, or set `external`"),
        ({"tau": TAU[:1], "external": True}, r"expected \(n,\) each"),
    ],
)
def test_clients_reject_contradictory_options_before_sending(streaming, options, message):
    with StreamClient("pendulum", streaming.server.url) as client:
        with pytest.raises(ValueError, match=message):
            client.send(*motions(1)[0], **options)
        assert client.predict(*motions(1)[0]).sequence == 1


@pytest.mark.parametrize("names", [JOINTS, ARM, (*ARM, "tau", "scale", *JOINTS, "tau_gravity")])
@pytest.mark.parametrize("rows", [None, 1, 5])
def test_open_inference_protocol_gives_the_same_values(streaming, measured, names, rows):
    queries, tau, expected = measured
    inputs = dict(zip(("q", "dq", "ddq", "tau"), (*queries.transpose(1, 0, 2), tau), strict=True))
    inputs = {name: values[0] if rows is None else values[:rows] for name, values in inputs.items()}
    result = tensors(infer(streaming.server.client, "pendulum", message(inputs, *names)))
    assert list(result) == list(names)
    for name in set(names) & expected.keys():
        values = expected[name][0] if rows is None else expected[name][:rows]
        assert result[name].shape == values.shape
        assert_allclose(result[name], values, **EXACT)


def test_open_inference_protocol_rejects_incomplete_inputs(streaming):
    motion = dict(zip(("q", "dq", "ddq"), motions(1)[0], strict=True))

    def rejection(inputs, *names):
        request = message(motion | inputs, *names)
        return error_message(streaming.server.client.post(infer_path("pendulum"), json=request))

    missing = "`tau` is required for forward_dynamics or tau_external"
    assert rejection({}, "tau_external_p").startswith(missing)
    assert rejection({"tau": TAU}).startswith("`tau` is used only for forward_dynamics or tau_external")
    assert rejection({"tau": [1.0]}, *JOINTS) == "tau.shape is [1], expected that of q, [2]"
    for name in ("tau_external_z", "tau_external_statistic"):
        assert rejection({"tau": [1e308, 0.0]}, name).startswith(f"{name}[0] is inf, expected a finite number")
