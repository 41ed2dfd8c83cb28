"""Torque queries: the service answers what lipcore's own model answers."""

import numpy as np
import pytest

from tests.service.data import error

EXACT = {"rtol": 1e-12, "atol": 1e-12}


@pytest.fixture(scope="module")
def motion():
    """Twelve instants of two joints, near the training data and away from it."""
    return dict(zip(("q", "dq", "ddq"), np.random.default_rng(4).uniform(-2, 2, (3, 12, 2)), strict=True))


def ask(api, model, motion, **request):
    body = {name: np.asarray(values).tolist() for name, values in motion.items()}
    answer = api.post(f"/v1/models/{model}/predict", json=body | request)
    assert answer.status_code == 200, answer.text
    return answer.json()


def test_a_batch_is_answered_as_lipcore_does(api, trained, motion):
    answer = ask(api, trained.name, motion, covariance=True)
    expected = trained.model.predict(**motion, covariance=True)
    np.testing.assert_allclose(answer["tau"], expected.tau, **EXACT)
    np.testing.assert_allclose(answer["tau_std"], expected.tau_std, **EXACT)
    np.testing.assert_allclose(answer["covariance"], expected.covariance, **EXACT)
    np.testing.assert_allclose(answer["noise_std"], expected.noise_std, **EXACT)


def test_a_single_query_is_answered_as_its_row_of_a_batch(api, trained, motion):
    batch = ask(api, trained.name, motion, covariance=True)
    for row in range(12):
        single = ask(api, trained.name, {name: values[row] for name, values in motion.items()}, covariance=True)
        for name in ("tau", "tau_std", "covariance"):
            np.testing.assert_allclose(single[name], batch[name][row], rtol=1e-9, atol=1e-12)


def refused(api, width=7, rows=None, **changes):
    """A query of zeros but for what is changed; the first of what is wrong with it."""
    zeros = np.zeros(width if rows is None else (rows, width)).tolist()
    answer = api.post("/v1/models/panda-sim/predict", json={"q": zeros, "dq": zeros, "ddq": zeros} | changes)
    return error(answer, 422, "invalid_request")["detail"][0]


@pytest.mark.parametrize("rows", [None, 2])
def test_what_the_model_cannot_answer_is_explained(strict, rows):
    joints = ", ".join(f"panda_joint{joint}" for joint in range(1, 8))
    assert refused(strict, 6, rows) == {"field": "q", "value": "6 numbers long", "expected": f"7 numbers: {joints}"}
    degrees = [0.0, -30.0, 0.0, -115.0, 0.0, 85.0, 40.0]
    problem = refused(strict, 7, rows, q=degrees if rows is None else [[0.0] * 7, degrees])
    assert problem["field"] == ("q[3]" if rows is None else "q[1][3]")
    assert "are these degrees?" in problem["expected"]


def test_a_batch_has_a_limit(strict):
    assert refused(strict, rows=21) == {"field": "q", "value": "21 queries", "expected": "at most 20 in one request"}


def test_large_velocities_are_answered_unclipped(strict):
    """Twice the speed is four times the centrifugal torque: nothing between is cut."""
    zero = [0.0] * 7
    slow, fast = (
        np.array(ask(strict, "panda-sim", {"q": zero, "dq": [speed, *zero[1:]], "ddq": zero})["tau"])
        for speed in (1e3, 2e3)
    )
    assert np.abs(slow).max() > 1e3
    assert np.abs(fast).max() > 1.5 * np.abs(slow).max()


@pytest.mark.parametrize("path", ["/v1/models/panda-sim/predict", "/v1/echo", "/v1/jobs"])
def test_bodies_beyond_the_limit_are_refused_however_they_come(strict, path):
    for body in (b"[" + b" " * 20_000, (b" " * 1000 for _ in range(21))):
        answer = strict.post(path, content=body, headers={"content-type": "application/json"})
        assert "20000 bytes" in error(answer, 413, "too_large")["message"]
