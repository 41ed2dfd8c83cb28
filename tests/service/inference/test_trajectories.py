"""The motion before a query: friction that remembers it follows the rows of a trajectory and a history."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from lipcore.data.motion import Motion
from lipcore.kernels.drive.play import ELEMENTS, MAX_GAP_S, with_deflections
from lipcore.model import dynamics
from service.contract.predictions import PredictRequest
from service.inference import predicting
from tests.lipcore.remembering import remembering_model, remembering_samples
from tests.service.data import error
from tests.service.inference.test_payload import POINT, model_with_payload
from tests.service.models.versions import predict, predict_json, publish

MODEL = "remembering"
ROWS = 200
EXACT = {"rtol": 1e-9, "atol": 1e-12}


@pytest.fixture(scope="module")
def model(api):
    """The model, which the service has as well."""
    publish(api, MODEL, remembering_model())
    return remembering_model()


@pytest.fixture(scope="module")
def samples():
    """Rows of a recording without deflections, as a client sends them."""
    return replace(remembering_samples(seed=8, size=ROWS), deflections=None)


def rows_of(samples, rows):
    """Return the motion of some rows, or of one."""
    return {name: getattr(samples, name)[rows] for name in ("q", "dq", "ddq")}


def history_of(samples, rows):
    return {name: getattr(samples, name)[rows].tolist() for name in ("t", "q", "dq")}


def deflections_of(samples):
    return with_deflections(samples, ["revolute"] * 2).deflections


@pytest.mark.parametrize("payload", [None, POINT])
def test_trajectory_and_history_answers_equal_lipcore(api, model, samples, payload):
    carrying = model if payload is None else model_with_payload(model, payload)
    deflections, start = deflections_of(samples), 25
    expected = carrying.predict(**rows_of(samples, slice(None)), covariance=True, deflections=deflections)
    more = {"covariance": True, "payload": payload}
    whole = predict_json(api, MODEL, **rows_of(samples, slice(None)), t=samples.t, trajectory=True, **more)
    later = predict_json(
        api,
        MODEL,
        **rows_of(samples, slice(start, None)),
        t=samples.t[start:],
        trajectory=True,
        history=history_of(samples, slice(start)),
        **more,
    )
    single = predict_json(
        api,
        MODEL,
        **rows_of(samples, start),
        t=float(samples.t[start]),
        history=history_of(samples, slice(start)),
        **more,
    )
    for name in ("tau", "tau_std", "covariance"):
        assert_allclose(whole[name], getattr(expected, name), **EXACT)
        assert_allclose(later[name], getattr(expected, name)[start:], **EXACT)
        assert_allclose(single[name], getattr(expected, name)[start], **EXACT)


def test_queries_alone_are_more_uncertain_at_low_speed(api, model, samples):
    motion = rows_of(samples, slice(None))
    alone, known = (predict_json(api, MODEL, **motion, **more) for more in ({}, {"t": samples.t, "trajectory": True}))
    reached = np.arange(ROWS) >= 100  # joints have moved by more than the widest element
    slow = (np.abs(samples.dq) < 0.2) & reached[:, None]
    assert slow.sum() > 5
    std = [np.array(each["tau_std"])[slow].mean() for each in (alone, known)]
    errors = [np.abs(np.subtract(each["tau"], samples.tau))[reached].mean() for each in (alone, known)]
    assert std[1] < 0.5 * std[0]
    assert errors[1] < 0.5 * errors[0]


def test_components_follow_the_motion(api, model, samples):
    samples = samples.rows(slice(100))
    names, motion = list(dynamics.COMPONENTS), rows_of(samples, slice(None))
    deflections = deflections_of(samples)
    tau = model.predict(**motion, deflections=deflections).tau
    expected = dynamics.components(model, Motion(**motion, deflections=deflections), names, tau)
    answer = predict_json(api, MODEL, **motion, t=samples.t, trajectory=True, components=names, tau=tau)["components"]
    for name, estimate in expected.items():
        size = float(np.abs(estimate.mean).max())
        assert_allclose(answer[name]["mean"], estimate.mean, rtol=1e-6, atol=1e-9 * size)
        assert_allclose(answer[name]["std"], estimate.std, rtol=1e-4, atol=1e-6 * size)
    parts = sum(np.array(answer[name]["mean"]) for name in ("inertial", "coriolis", "gravity", "friction"))
    certain = (deflections[:, len(ELEMENTS) :] == 0).all(axis=(1, 2))  # the sum is exact for these rows
    assert certain.sum() > 10
    assert_allclose(parts[certain], tau[certain], rtol=1e-6, atol=1e-9)
    alone = predict_json(api, MODEL, **motion, components=["friction"])["components"]["friction"]
    assert np.abs(np.subtract(answer["friction"]["mean"], alone["mean"])).max() > 0.1


def test_motion_before_a_gap_is_ignored(api, model, samples):
    """The description of the field in the API states the same gap."""
    assert f"{MAX_GAP_S:g} s" in str(PredictRequest.model_fields["history"].description)
    query = rows_of(samples, 30) | {"history": history_of(samples, slice(30))}
    end = float(samples.t[29])
    followed, late, later = (
        predict_json(api, MODEL, **query, t=end + gap)["tau_std"] for gap in (0.01, MAX_GAP_S + 0.01, 1.0)
    )
    assert late == later
    assert (np.array(followed) < late).all()


def test_models_that_do_not_remember_answer_as_without(api, trained):
    samples = trained.samples.rows(slice(10))
    motion = rows_of(samples, slice(5, None))
    found = predict_json(
        api, trained.name, **motion, t=samples.t[5:], trajectory=True, history=history_of(samples, slice(5))
    )
    assert found == predict_json(api, trained.name, **motion)


def test_clock_of_any_origin_gives_the_same_answer(api, model, samples):
    motion = rows_of(samples, slice(None))
    first, other = (predict_json(api, MODEL, **motion, t=samples.t + origin, trajectory=True) for origin in (0.0, -1e6))
    assert_allclose(other["tau"], first["tau"], **EXACT)


TIMES = [0.0, 0.01, 0.02]
PAST = {"t": [-0.02, -0.01], "q": [[0.0, 0.0]] * 2, "dq": [[0.0, 0.0]] * 2}
BATCH = {"t": TIMES, "trajectory": True, "history": PAST}
WRONG = {
    "single trajectory": (
        {"t": 0.0, "trajectory": True},
        ("trajectory", "true", "false for one query"),
        "`trajectory` needs a batch of rows in order of time; this is one query.",
    ),
    "history of a batch": (
        BATCH | {"trajectory": False},
        ("history", "given", "no history, or a trajectory"),
        "`history` of a batch needs `trajectory`: true. Otherwise each row is a query alone.",
    ),
    "trajectory without times": (
        BATCH | {"t": None, "history": None},
        ("t", "missing", "times of the rows, s"),
        "`t` is required for `trajectory` and `history`.",
    ),
    "history without time": (
        {"history": PAST},
        ("t", "missing", "times of the rows, s"),
        "`t` is required for `trajectory` and `history`.",
    ),
    "times alone": (
        {"t": TIMES},
        ("t", "given", "no t, or a trajectory or history"),
        "`t` is used only for `trajectory` and `history`.",
    ),
    "too few times": (
        BATCH | {"t": TIMES[:2]},
        ("t", "2 values", "3 values, one for each row"),
        "`t` has 2 values; `q` has 3 rows.",
    ),
    "times that repeat": (BATCH | {"t": [0.0, 0.5, 0.5]}, ("t[2]", "0.5", "a time after t[1], 0.5"), None),
    "times that fall": (BATCH | {"t": [0.0, 0.5, 0.25]}, ("t[2]", "0.25", "a time after t[1], 0.5"), None),
    "history that falls": (
        BATCH | {"history": PAST | {"t": [-0.01, -0.02]}},
        ("history.t[1]", "-0.02", "a time after history.t[0], -0.01"),
        None,
    ),
    "history that overlaps": (
        BATCH | {"history": PAST | {"t": [-0.01, 0.0]}},
        ("t[0]", "0", "a time after 0, the end of the history"),
        "`t` begins at 0; it must be after 0, the end of the history.",
    ),
    "too few times of the history": (
        BATCH | {"history": PAST | {"t": [-0.01]}},
        ("history.t", "1 values", "2 values, one for each row"),
        "`history.t` has 1 values; `history.q` has 2 rows.",
    ),
    "history of one row without axis": (
        BATCH | {"history": {"t": [-0.01], "q": [0.0, 0.0], "dq": [0.0, 0.0]}},
        ("history.q", "of shape (2,)", "rows of positions, (N, n)"),
        "`history.q` has shape (2,); it must be a list of rows.",
    ),
    "history of other joints": (
        BATCH | {"history": PAST | {"q": [[0.0]] * 2}},
        ("history.q", "1 values", "2 values: joint1, joint2"),
        "`history.q` has 1 values; this model has 2 joints: joint1, joint2.",
    ),
    "history with too few velocities": (
        BATCH | {"history": PAST | {"dq": [[0.0, 0.0]]}},
        ("history.dq", "of shape (1, 2)", "the shape of history.q, (2, 2)"),
        "`history.dq` has shape (1, 2); `history.q` has shape (2, 2).",
    ),
    "history in degrees": (
        BATCH | {"history": PAST | {"q": [[0.0, 0.0], [0.0, 90.0]]}},
        ("history.q[1][1]", "90", "radians (or metres) within ±12.6: are these degrees?"),
        None,
    ),
    "history that is too long": (
        BATCH | {"history": {"t": [-1.0] * 1001, "q": [[0.0, 0.0]] * 1001, "dq": [[0.0, 0.0]] * 1001}},
        ("history.q", "1001 rows", "at most 1000"),
        None,
    ),
    "number that is not finite": (
        BATCH | {"history": PAST | {"dq": [[0.0, 0.0], [None, 0.0]]}},
        ("history.dq[1][0]", None, "a finite number"),
        None,
    ),
    "time that is no number": (BATCH | {"t": [0.0, "1", 2.0]}, ("t[1]", "1", "a finite number"), None),
    "history without velocities": (
        BATCH | {"history": {"t": PAST["t"], "q": PAST["q"]}},
        ("history.dq", None, None),
        None,
    ),
}


@pytest.mark.parametrize("name", WRONG)
@pytest.mark.parametrize("remembers", [True, False])
def test_wrong_times_and_histories_are_explained(api, model, trained, name, remembers):
    fields, (field, value, expected), message = WRONG[name]
    batch = isinstance(fields.get("t"), list) or fields.keys() == BATCH.keys()
    query = dict.fromkeys(("q", "dq", "ddq"), [[0.0, 0.0]] * 3 if batch else [0.0, 0.0])
    reply = error(predict(api, MODEL if remembers else trained.name, **query, **fields), 422, "invalid_request")
    (problem,) = reply["detail"]
    assert problem["field"] == field
    assert value is None or problem["value"] == value
    assert expected is None or problem["expected"] == expected
    assert message is None or reply["message"] == message


def test_trajectory_has_the_limits_of_a_batch(strict):
    query = dict.fromkeys(("q", "dq", "ddq"), [[0.0] * 7] * 21)
    reply = error(predict(strict, "panda-sim", **query, t=list(range(21)), trajectory=True), 422, "invalid_request")
    assert reply["detail"][0] == {"field": "q", "value": "21 queries", "expected": "at most 20 in one request"}


def test_longest_history_is_answered(api, model):
    t, rows = np.arange(-predicting.MAX_HISTORY, 0) * 1e-3, np.zeros((predicting.MAX_HISTORY, 2))
    zero = np.zeros(2)
    query = {"q": zero, "dq": zero, "ddq": zero, "t": 0.0}
    history = {"t": t.tolist(), "q": rows.tolist(), "dq": rows.tolist()}
    found = predict_json(api, MODEL, **query, history=history)
    assert np.isfinite(found["tau"]).all()
