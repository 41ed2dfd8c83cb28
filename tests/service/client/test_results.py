"""Results of the client: arrays, intervals of measurements, tables."""

from __future__ import annotations

import json

import numpy as np
import pytest

from service.client.call import Answer
from service.client.results.evaluation import read_comparison, read_evaluation
from service.client.results.series import LiveRows, read_live
from service.learning.control.schema import LiveLost
from tests.service.data import stream, upload

EVALUATION = {
    "model": "m<b>",
    "version": 2,
    "revision": 3,
    "dataset": "ds_1",
    "part": "all",
    "joint_names": ["a", "b"],
    "samples": 100,
    "samples_used": 50,
    "level": 0.95,
    "nmse": [0.0123, None],
    "rmse": [0.5, 0.25],
    "coverage": [0.94, 1.0],
    "nlpd": [-1.5, 0.125],
    "interval_width": [2.0, 1.0],
    "coverages": [{"level": 0.5, "coverage": [0.5, 0.6], "interval_width": [0.7, 0.4]}],
    "reliability": {"nominal": [0.5, 0.9], "observed": [[0.5, 0.9], [0.6, 0.95]]},
    "stretches": {"kind": "equal", "samples": [25, 25], "nmse": [[0.01, 0.02], [None, None]]},
    "in_training": True,
}


def answer(said, event=""):
    return Answer(200, json.dumps(said).encode(), event=event)


def test_predictions_are_arrays(api, local):
    q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.5, 0.7])
    one = local.predict("panda-sim", q, 0 * q, 0 * q, covariance=True, components=["gravity", "potential_energy"])
    many = local.predict("panda-sim", [q, q], np.zeros((2, 7)), np.zeros((2, 7)))
    assert (one.tau.shape, many.tau.shape, many.noise_std.shape, one.covariance.shape) == ((7,), (2, 7), (7,), (7, 7))
    assert (one.components["gravity"].mean.shape, one.components["potential_energy"].std.shape) == ((7,), ())
    np.testing.assert_allclose(many.tau[1], one.tau, rtol=1e-9)
    assert one.joint_names[0] == "panda_joint1"
    assert (many.covariance, many.components) == (None, None)
    said = api.post("/v1/models/panda-sim/predict", json={"q": [*q], "dq": [0] * 7, "ddq": [0] * 7}).json()
    assert json.loads(json.dumps(local.predict("panda-sim", q, 0 * q, 0 * q).as_dict())) == said


def test_intervals_are_those_of_measurements(local):
    zero = np.zeros(7)
    found = local.predict("panda-sim", zero, zero, zero)
    lower, upper = found.interval()
    np.testing.assert_allclose((upper - lower) / 2, 1.959964 * np.hypot(found.tau_std, found.noise_std), rtol=1e-6)
    np.testing.assert_allclose((lower + upper) / 2, found.tau)
    wider = found.interval(0.99)
    assert (wider[1] > upper).all()
    for level in (0.0, 1.0, 95):
        with pytest.raises(ValueError, match="expected a probability"):
            found.interval(level)


def test_an_evaluation_is_a_table():
    found = read_evaluation(answer(EVALUATION))
    assert str(found).splitlines() == [
        "m<b> version 2 on 50 samples of ds_1, which it was trained on: these figures flatter",
        "joint      nMSE  RMSE N·m  coverage of 95%  width N·m  NLPD nats",
        "a      1.23e-02    0.5000            94.0%      2.000     -1.500",
        "b             -    0.2500           100.0%      1.000      0.125",
    ]
    html = found._repr_html_()
    assert "<caption>m&lt;b&gt; version 2" in html
    assert "<td>1.23e-02</td>" in html
    first, second = found.rows()
    assert (first["joint"], first["nmse"], first["coverage"], second["rmse"]) == ("a", 0.0123, 0.94, 0.25)
    assert np.isnan(second["nmse"])
    assert found.as_dict() == EVALUATION
    assert (found.reliability.observed.shape, found.stretches.nmse.shape) == ((2, 2), (2, 2))


def test_held_out_samples_are_said_to_be():
    found = read_evaluation(answer({**EVALUATION, "part": "held_out", "in_training": False}))
    assert found.title == "m<b> version 2 on 50 held-out samples of ds_1"


def test_an_evaluation_says_what_the_service_says(api, local, trained):
    found = local.evaluate(trained.name, trained.dataset)
    asked = {"dataset": trained.dataset}
    assert found.as_dict() == api.post(f"/v1/models/{trained.name}/evaluate", json=asked).json()
    assert found.in_training


def test_a_comparison_says_its_verdict_and_what_makes_it_unfair():
    figures = {name: EVALUATION[name] for name in ("nmse", "rmse", "coverage", "nlpd", "interval_width")}
    versions = [{"version": version, "revision": 0, **figures, "in_training": version == 1} for version in (1, 2)]
    nothing = {"difference": None, "standard_error": None, "half_width": None}
    joints = {"difference": [0.1, None], "standard_error": [None, None], "half_width": [None, None]}
    body = {
        "model": "m",
        "dataset": "ds_1",
        "joint_names": ["a", "b"],
        "samples": 100,
        "samples_used": 50,
        "blocks": 1,
        "versions": versions,
        "differences": dict.fromkeys(("nmse", "rmse", "coverage", "nlpd"), joints),
        "nlpd": nothing,
        "nmse": nothing,
        "outcome": "cannot_tell",
        "better": None,
        "verdict": "cannot tell",
        "warnings": ["version 1 was trained on it"],
    }
    found = read_comparison(answer(body))
    assert str(found) == "cannot tell\ncareful: version 1 was trained on it"
    assert np.isnan(found.nlpd.difference)
    assert found.differences["nmse"].difference[0] == 0.1
    assert [each.in_training for each in found.versions] == [True, False]


def test_a_preview_has_its_columns(local, pendulum):
    found = local.preview(pendulum["id"], ["q", "tau"], points=10)
    assert (found.samples, found.starts.tolist()) == (80, [0])
    assert {(each.quantity, len(each.rows) <= 10) for each in found.columns} == {("q", True), ("tau", True)}
    column = found.column("tau", stream().joint_names[1])
    assert column.unit == "N·m or N"
    np.testing.assert_allclose(column.values, stream().tau[column.rows, 1])
    np.testing.assert_allclose(column.t, stream().t[column.rows])
    with pytest.raises(KeyError, match="no column of ddq"):
        found.column("ddq", stream().joint_names[1])


def test_a_trace_stands_beside_what_was_measured(local, trained):
    found = local.trace(trained.name, trained.dataset, points=20, start=10, components=["friction"])
    assert (found.samples, found.in_range, found.shown, found.in_training) == (80, 70, 20, True)
    np.testing.assert_allclose(found.tau, trained.samples.tau[found.rows])
    lower, upper = found.interval()
    assert (lower < found.mean).all()
    assert (upper > found.mean).all()
    assert found.components["friction"].mean.shape == (20, 2)
    assert local.trace(trained.name, trained.dataset, stop=5).mean.shape == (5, 2)


def test_live_rows_are_arrays():
    part = {
        "stream_id": "arm",
        "version": 1,
        "revision": 0,
        "rows": 50,
        "counts": {"learnt": 49, "contact": 1},
        "worst": [2.0, None],
        "noise_std": [0.3, 0.4],
        "q": [0.1, -0.2],
        "time": [1.0, None],
        "tau": [[1.0, 2.0], [None, 1.0]],
        "mean": [[0.5, 2.0], [0.0, 1.0]],
        "std": [[0.4, 0.3], [0.4, 0.3]],
        "code": ["learnt", "contact"],
    }
    found = read_live(answer({"parts": [part]}, "rows"))
    assert isinstance(found, LiveRows)
    (only,) = found.parts
    np.testing.assert_allclose(only.innovation, [[1.0, 0.0], [np.nan, 0.0]])
    assert only.as_dict() == part
    assert read_live(answer({"events": 4}, "lost")) == LiveLost(events=4)
    assert read_live(answer({}, "something new")) is None


def test_lists_go_over_all_pages(strict):
    from tests.service.client.conftest import over

    made = [upload(strict, stream(samples=30, seed=seed))["id"] for seed in range(5)]  # three fit on a page
    client = over(strict._transport)
    found = client.datasets()
    assert next(found).id == made[-1]
    assert [each.id for each in found] == made[-2::-1]
