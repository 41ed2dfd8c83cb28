"""Torques that the training does not determine: over HTTP, the Open Inference Protocol, and a stream."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from lipserve import Client, StreamClient
from tests.service.api.oip.requests import infer, message, tensors
from tests.service.models.versions import predict_json
from tests.service.streams import (
    ASK_EXTERNAL,
    EXTERNAL,
    FALLBACK,
    STD,
    frame,
    motions,
    open_stream,
    read_hello,
    send_frame,
)

EXACT = {"rtol": 1e-7, "atol": 1e-9}
NEAR, FAR = motions(1)[0], motions(1)[0] * np.array([[1.0], [200.0], [200.0]])


def query(*rows):
    """Return motions (N, 3, n) as the fields of a request."""
    return dict(zip(("q", "dq", "ddq"), np.stack(rows, axis=1), strict=True))


@pytest.fixture(scope="module")
def expected(trained):
    """The answer of lipcore near the training data and far from them."""
    answer = trained.model.predict(**query(NEAR, FAR), covariance=True)
    assert answer.fallback is not None
    assert answer.fallback.share[0].max() == 0
    assert answer.fallback.share[1].max() == 1
    return answer


def test_http_answers_the_fallback_share_of_each_joint(api, trained, expected):
    both, far = query(NEAR, FAR), {name: values[0] for name, values in query(FAR).items()}
    batch, single = (predict_json(api, trained.name, **motion) for motion in (both, far))
    assert_allclose(batch["fallback"], expected.fallback.share, **EXACT)
    assert_allclose(batch["tau"], expected.tau, **EXACT)
    assert_allclose(batch["tau_std"], expected.tau_std, **EXACT)
    assert [single[name] for name in ("fallback", "tau")] == [batch[name][1] for name in ("fallback", "tau")]


def test_http_omits_the_field_without_fallback(api, trained):
    for motion in (query(NEAR), {name: values[0] for name, values in query(NEAR).items()}):
        assert "fallback" not in predict_json(api, trained.name, **motion)


@pytest.mark.parametrize("rows", [[NEAR], [FAR], [NEAR, FAR]], ids=["near", "far", "both"])
def test_open_inference_protocol_answers_it_on_request(api, trained, expected, rows):
    found = tensors(infer(api, trained.name, message(query(*rows), "fallback", "tau")))
    places = [0 if row is NEAR else 1 for row in rows]
    assert_allclose(found["fallback"], expected.fallback.share[places], **EXACT)
    assert_allclose(found["tau"], expected.tau[places], **EXACT)


@pytest.mark.parametrize("rows", [[FAR], [NEAR, FAR]], ids=["one", "batch"])
def test_external_torque_is_relative_to_the_posterior_mean(api, trained, expected, rows):
    measured = expected.fallback.mean[-len(rows) :]
    request = message(query(*rows) | {"tau": measured}, "tau_external", "tau_external_statistic")
    found = tensors(infer(api, trained.name, request))
    assert_allclose(found["tau_external"], 0.0, atol=1e-6 * np.abs(measured).max())
    assert_allclose(found["tau_external_statistic"], 0.0, atol=1e-6)


@pytest.mark.slow
def test_stream_flags_fallback(streaming):
    found = streaming.model.answer_fully(FAR)
    assert found.fallback is not None
    with open_stream(streaming.server) as connection:
        read_hello(connection)
        near, far = (send_frame(connection, frame(motion, number)) for number, motion in enumerate((NEAR, FAR)))
        compared = send_frame(connection, frame(FAR, 2, STD | ASK_EXTERNAL, tau=found.mean, learn=False))
    assert (near.flags, far.flags, compared.flags) == (STD, STD | FALLBACK, STD | FALLBACK | EXTERNAL)
    assert_allclose(far.tau, found.tau, **EXACT)
    assert_allclose(compared.external[:2], 0.0, atol=1e-6 * np.abs(found.mean).max())


def test_clients_read_fallback(streaming):
    with Client(streaming.server.url) as client:
        assert client.predict("pendulum", *NEAR).fallback is None
        share = client.predict("pendulum", *FAR).fallback
    assert_allclose(share, streaming.model.answer_fully(FAR).fallback.share, **EXACT)
    with StreamClient("pendulum", streaming.server.url) as stream:
        assert [stream.predict(*motion).fallback for motion in (NEAR, FAR)] == [False, True]
