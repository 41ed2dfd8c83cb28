"""Torque queries: the service returns what lipcore's model returns."""

import numpy as np
import pytest

from tests.service.data import error
from tests.service.models.versions import predict, predict_json


@pytest.fixture(scope="module")
def motion():
    """Twelve states of two joints, near the training data and far from it."""
    return dict(zip(("q", "dq", "ddq"), np.random.default_rng(4).uniform(-2, 2, (3, 12, 2)), strict=True))


def test_batch_is_answered_as_by_lipcore(api, trained, motion):
    answer = predict_json(api, trained.name, **motion, covariance=True)
    expected = trained.model.predict(**motion, covariance=True)
    for name in ("tau", "tau_std", "covariance", "noise_std"):
        np.testing.assert_allclose(answer[name], getattr(expected, name), rtol=1e-12, atol=1e-12)


def test_single_query_is_answered_as_a_row_of_a_batch(api, trained, motion):
    batch = predict_json(api, trained.name, **motion, covariance=True)
    for row in range(12):
        query = {name: values[row] for name, values in motion.items()}
        single = predict_json(api, trained.name, **query, covariance=True)
        for name in ("tau", "tau_std", "covariance"):
            np.testing.assert_allclose(single[name], batch[name][row], rtol=1e-9, atol=1e-12)


def rejection(api, width=7, rows=None, **changes):
    """Send a query of zeros with some changes; return the first detail of its error."""
    query = dict.fromkeys(("q", "dq", "ddq"), np.zeros(width if rows is None else (rows, width)))
    return error(predict(api, "panda-sim", **(query | changes)), 422, "invalid_request")["detail"][0]


@pytest.mark.parametrize("rows", [None, 2])
def test_unanswerable_query_is_explained(strict, rows):
    joints = ", ".join(f"panda_joint{joint}" for joint in range(1, 8))
    assert rejection(strict, 6, rows) == {"field": "q", "value": "6 values", "expected": f"7 values: {joints}"}
    degrees = [0.0, -30.0, 0.0, -115.0, 0.0, 85.0, 40.0]
    problem = rejection(strict, 7, rows, q=degrees if rows is None else [[0.0] * 7, degrees])
    assert problem["field"] == ("q[3]" if rows is None else "q[1][3]")
    assert "are these degrees?" in problem["expected"]


def test_batch_size_is_limited(strict):
    assert rejection(strict, rows=21) == {"field": "q", "value": "21 queries", "expected": "at most 20 in one request"}


def test_large_velocities_are_not_clipped(strict):
    """Twice the speed gives four times the centrifugal torque, so no value in between is clipped."""
    zero, one = np.zeros(7), np.eye(7)[0]
    slow, fast = (
        np.abs(predict_json(strict, "panda-sim", q=zero, dq=speed * one, ddq=zero)["tau"]).max() for speed in (1e3, 2e3)
    )
    assert slow > 1e3
    assert fast > 1.5 * slow


@pytest.mark.parametrize("path", ["/v1/models/panda-sim/predict", "/v1/echo", "/v1/jobs"])
def test_bodies_beyond_the_limit_are_rejected(strict, path):
    for body in (b"[" + b" " * 20_000, (b" " * 1000 for _ in range(21))):
        answer = strict.post(path, content=body, headers={"content-type": "application/json"})
        assert "20000 bytes" in error(answer, 413, "too_large")["message"]
