"""Results of the client: arrays, intervals of measurements, tables, and the estimated arm."""

import json

import msgspec
import numpy as np
import pinocchio as pin
import pytest

from lipcore.robots.urdf import RigidBody
from lipserve.call import Answer
from lipserve.records.live import LiveLost
from lipserve.records.verdicts import Verdict
from lipserve.results.arm import Arm, Version, read_arm
from lipserve.results.evaluation import read_evaluation
from lipserve.results.series import LiveRows, read_live
from tests.clients.python.conftest import over
from tests.lipcore.arms import parameters_of
from tests.lipcore.remembering import remembering_model, remembering_samples
from tests.service.data import stream, upload
from tests.service.models.versions import JOINTS, panda, publish

UNJUDGED = {
    **{"level": "not_judged", "serves": False, "label": "not judged", "reason": "It was <trained>.", "action": "Wait."},
    **{"judged_on": "training", "outside": 0.25, "repeats": None, "joints": []},
}
EVALUATION = {
    **{"model": "m<b>", "version": 2, "revision": 3, "dataset": "ds_1", "part": "all", "joint_names": ["a", "b"]},
    **{"samples": 100, "samples_used": 50, "level": 0.95, "nmse": [0.0123, None], "rmse": [0.5, 0.25]},
    **{"coverage": [0.94, 1.0], "nlpd": [-1.5, 0.125], "interval_width": [2.0, 1.0], "in_training": True},
    **{"independent": [12.4, 8.0], "coverage_low": [0.6, 0.63], "coverage_high": [1.0, 1.0]},
    **{"repeats_training": 0.97, "period_s": 5.0, "warnings": ["97 % repeat: <flatters>"], "judged": False},
    **{
        "seconds": 5.0,
        "moving": 1.0,
        "torque_range": [4.0, 2.0],
        "outside": {"share": 0.25, "squared": [0.5, 0.1], "coverage": [0.9, 1.0]},
    },
    "verdict": UNJUDGED,
    "coverages": [{"level": 0.5, "coverage": [0.5, 0.6], "interval_width": [0.7, 0.4]}],
    "reliability": {"nominal": [0.5, 0.9], "observed": [[0.5, 0.9], [0.6, 0.95]]},
    "stretches": {"kind": "equal", "samples": [25, 25], "nmse": [[0.01, 0.02], [None, None]]},
}


def answer(body, event=""):
    return Answer(200, json.dumps(body).encode(), event=event)


def test_predictions_are_arrays(api, local):
    q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.5, 0.7])
    one = local.predict("panda-sim", q, 0 * q, 0 * q, covariance=True, components=["gravity", "potential_energy"])
    many = local.predict("panda-sim", [q, q], np.zeros((2, 7)), np.zeros((2, 7)))
    assert (one.tau.shape, many.tau.shape, many.noise_std.shape, one.covariance.shape) == ((7,), (2, 7), (7,), (7, 7))
    assert (one.components["gravity"].mean.shape, one.components["potential_energy"].std.shape) == ((7,), ())
    np.testing.assert_allclose(many.tau[1], one.tau, rtol=1e-9)
    assert one.joint_names[0] == "panda_joint1"
    assert (many.covariance, many.components) == (None, None)
    plain = api.post("/v1/models/panda-sim/predict", json={"q": [*q], "dq": [0] * 7, "ddq": [0] * 7}).json()
    assert json.loads(json.dumps(local.predict("panda-sim", q, 0 * q, 0 * q).as_dict())) == plain

    lower, upper = one.interval()  # of a measurement
    np.testing.assert_allclose((upper - lower) / 2, 1.959964 * np.hypot(one.tau_std, one.noise_std), rtol=1e-6)
    np.testing.assert_allclose((lower + upper) / 2, one.tau)
    assert (one.interval(0.99)[1] > upper).all()
    for level in (0.0, 1.0, 95):
        with pytest.raises(ValueError, match="expected a probability"):
            one.interval(level)


def test_times_and_a_history_make_one_motion(api, local):
    publish(api, "remembers", remembering_model())
    samples = remembering_samples(seed=8, size=60)
    motion, row = (samples.q, samples.dq, samples.ddq), 30
    expected = remembering_model().predict_along(samples)
    whole = local.predict("remembers", *motion, t=samples.t)
    later, single = (
        local.predict(
            "remembers",
            *(each[rows] for each in motion),
            t=samples.t[rows],
            history=(samples.t[:row], samples.q[:row], samples.dq[:row]),
        )
        for rows in (slice(row, None), row)
    )
    for found, rows in ((whole, slice(None)), (later, slice(row, None)), (single, row)):
        np.testing.assert_allclose(found.tau, expected.tau[rows], rtol=1e-9)
        np.testing.assert_allclose(found.tau_std, expected.tau_std[rows], rtol=1e-9)
    one = (samples.t[row - 1], samples.q[row - 1], samples.dq[row - 1])  # a history of one row
    after_one = local.predict("remembers", *(each[row] for each in motion), t=samples.t[row], history=one)
    assert (after_one.tau_std > single.tau_std).all()


def test_evaluation_prints_as_a_table():
    found = read_evaluation(answer(EVALUATION))
    assert str(found).splitlines() == [
        "m<b> version 2 on 50 samples of ds_1 (training data: figures are too optimistic)",
        "joint      nMSE  RMSE N·m  coverage (95 %)  95 % CI from     to  effective samples  width N·m  NLPD nats",
        "a      1.23e-02    0.5000           94.0 %          60 %  100 %                 12      2.000     -1.500",
        "b             -    0.2500          100.0 %          63 %  100 %                  8      1.000      0.125",
        "not judged: It was <trained>.",
        "warning: 97 % repeat: <flatters>",
    ]
    html = found._repr_html_()
    assert html.endswith("<p>not judged: It was &lt;trained&gt;.</p><p>warning: 97 % repeat: &lt;flatters&gt;</p>")
    assert [part for part in ("<caption>m&lt;b&gt; version 2", "<td>1.23e-02</td>") if part not in html] == []
    first, second = found.rows()
    assert (first["joint"], first["nmse"], first["coverage"], second["rmse"]) == ("a", 0.0123, 0.94, 0.25)
    assert np.isnan(second["nmse"])
    assert found.as_dict() == EVALUATION
    assert (found.reliability.observed.shape, found.stretches.nmse.shape) == ((2, 2), (2, 2))
    held_out = read_evaluation(answer({**EVALUATION, "part": "held_out", "in_training": False}))
    assert held_out.title == "m<b> version 2 on 50 held-out samples of ds_1"


def test_evaluation_as_dict_equals_the_answer(api, local, trained):
    asked = {"dataset": trained.dataset}
    answered = api.post(f"/v1/models/{trained.name}/evaluate", json=asked).json()
    unknown = {"repeats_training": None, "period_s": None}  # of samples that it was trained on
    found = local.evaluate(trained.name, trained.dataset).as_dict()
    assert found["outside"] == {"share": 0.0, "squared": [None, None], "coverage": [None, None]}
    assert found | unknown == answered


def test_comparison_prints_verdict_and_warnings(api, local, pendulum):
    publish(api, "client-compared", lineage={"datasets": [pendulum]})
    publish(api, "client-compared")
    compared = local.compare("client-compared", pendulum["id"], 1, 2)
    (warning,) = compared.warnings
    assert str(compared) == f"{compared.verdict}\nwarning: {warning}"
    assert [each.in_training for each in compared.versions] == [True, False]
    asked = {"dataset": pendulum["id"], "versions": [1, 2]}
    answered = api.post("/v1/models/client-compared/compare", json=asked).json()
    assert compared.as_dict() | {"better": None} == answered


def test_preview_has_columns(local, pendulum):
    found = local.preview(pendulum["id"], ["q", "tau"], points=10)
    assert (found.samples, found.starts.tolist()) == (80, [0])
    assert {(each.quantity, len(each.rows) <= 10) for each in found.columns} == {("q", True), ("tau", True)}
    column = found.column("tau", stream().joint_names[1])
    assert column.unit == "N·m or N"
    np.testing.assert_allclose(column.values, stream().tau[column.rows, 1])
    np.testing.assert_allclose(column.t, stream().t[column.rows])
    with pytest.raises(KeyError, match="no column for ddq"):
        found.column("ddq", stream().joint_names[1])


def test_trace_matches_measurements(local, trained):
    found = local.trace(trained.name, trained.dataset, points=20, start=10, components=["friction"])
    assert (found.samples, found.in_range, found.shown, found.in_training) == (80, 70, 20, True)
    np.testing.assert_allclose(found.tau, trained.samples.tau[found.rows])
    lower, upper = found.interval()
    assert ((lower < found.mean) & (found.mean < upper)).all()
    assert found.components["friction"].mean.shape == (20, 2)
    assert local.trace(trained.name, trained.dataset, stop=5).mean.shape == (5, 2)


def test_live_rows_are_arrays():
    part = {
        **{"stream_id": "arm", "version": 1, "revision": 0, "rows": 50, "counts": {"learnt": 49, "contact": 1}},
        **{"worst": [2.0, None], "noise_std": [0.3, 0.4], "q": [0.1, -0.2], "time": [1.0, None]},
        **{"tau": [[1.0, 2.0], [None, 1.0]], "mean": [[0.5, 2.0], [0.0, 1.0]], "std": [[0.4, 0.3], [0.4, 0.3]]},
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
    made = [upload(strict, stream(samples=30, seed=seed))["id"] for seed in range(5)]  # three fit on a page
    assert [each.id for each in over(strict._transport).datasets()] == made[::-1]


REVERSED = JOINTS[::-1]


def version(parameters, **given) -> Version:
    known = {"model": "m", "version": 1, "created_at": "2026-01-01T00:00:00+00:00", "job": None, "estimator": "lip"}
    known |= {"joint_names": list(REVERSED), "joint_types": ["revolute"] * 7, "torque_convention": "gravity_included"}
    known |= {"noise_std": [0.1] * 7, "parameters": parameters, "warnings": [], "components": []}
    nothing = ("training_range", "options", "fit", "compact", "calibration", "hyperparameters", "lineage")
    known["verdict"] = msgspec.convert(UNJUDGED, Verdict)
    return Version(**{**known, **{name: {} for name in nothing}, **given})


@pytest.fixture(scope="module")
def robot():
    return RigidBody.from_profile("panda", REVERSED, panda().joint_types)


@pytest.fixture
def arm(robot) -> Arm:
    return read_arm(version(parameters_of(robot)))


def test_arm_matches_pinocchio(robot, arm):
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, np.zeros(7))
    joints = list(data.oMi)[1:]
    assert arm.joint_names == JOINTS
    np.testing.assert_allclose(arm.frames.place, [each.translation for each in joints], atol=1e-12)
    np.testing.assert_allclose(arm.frames.axis, [each.rotation[:, 2] for each in joints], atol=1e-12)
    bodies = list(robot.model.inertias)[1:]
    np.testing.assert_allclose(arm.mass, [each.mass for each in bodies])
    np.testing.assert_allclose(arm.centre, [each.lever for each in bodies], atol=1e-12)


def test_deviations_of_centres_match_random_draws(robot, arm):
    """First moment and mass are drawn independently, because the manifest has no covariance of them."""
    body = parameters_of(robot)["inertia"]["bodies"][-1]  # of the first joint
    mean, std = body["plausible"], body["std"]
    rng = np.random.default_rng(0)
    draws = rng.normal(mean["first_moment"], std["first_moment"], (100_000, 3))
    draws /= rng.normal(mean["mass"], std["mass"], (100_000, 1))
    np.testing.assert_allclose(arm.centre_std[0], draws.std(axis=0), rtol=0.03)


def test_text_and_html_show_every_joint_and_unidentifiable_parameters(arm):
    parts = (*JOINTS, "shift 2", "mirror image", "0.1 ± 0.01", "0.057, 0.11", "torque deviation N·m")
    assert [part for part in parts if part not in str(arm)] == []
    assert "<td>mass, first moment</td>" in arm._repr_html_()
    assert arm.as_dict()["frames"]["mode"] == "learn"


@pytest.mark.parametrize(
    ("kind", "head"),
    [
        ("stribeck", "at low speed N·m"),
        ("load", "share of the load"),
        ("breakaway", "breakaway N·m"),
        ("stiffness", "presliding N·m/rad"),
    ],
)
def test_further_friction_is_shown_if_estimated(robot, arm, kind, head):
    parameters = parameters_of(robot)
    parameters["friction"][kind] = {"mean": [float(k) for k in range(7)], "std": [0.01] * 7}
    shown = read_arm(version(parameters))
    np.testing.assert_allclose(shown.friction[kind][0], range(6, -1, -1))
    assert list(shown.tables()["friction"])[-1] == head
    assert kind not in arm.friction
    assert head not in str(arm)


def test_version_prints_warnings_and_arm(robot):
    known = version(parameters_of(robot), estimator="rigid-body", warnings=["joint 3 hardly moved"])
    lines = str(known).splitlines()
    assert lines[:2] == [f"m version 1: rigid-body, 7 joints: {', '.join(REVERSED)}", "warning: joint 3 hardly moved"]
    assert str(known.arm) in str(known)
    without = version({"friction": parameters_of(robot)["friction"]})
    assert (read_arm(without), str(version({"friction": {}})).endswith(REVERSED[-1])) == (None, True)
