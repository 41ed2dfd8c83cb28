"""Evaluation: figures of lipcore's metrics on the samples of a data set."""

from __future__ import annotations

import numpy as np
import pytest

import lipcore
from lipcore.data.metrics import evaluate
from service.models import registry
from tests.service.data import arrays, error, npz, post, service_of, stream, upload

FIGURES = ("nmse", "rmse", "coverage", "nlpd")


def compare(answer, metrics):
    for name in FIGURES:
        np.testing.assert_allclose(np.array(answer[name], dtype=float), getattr(metrics, name), rtol=1e-10)
    np.testing.assert_allclose(answer["interval_width"], metrics.width, rtol=1e-10)
    assert answer["level"] == metrics.level == 0.95
    for row, interval in enumerate(answer["coverages"]):
        np.testing.assert_allclose(interval["coverage"], metrics.coverages[row], rtol=1e-10)
        np.testing.assert_allclose(interval["interval_width"], metrics.widths[row], rtol=1e-10)
    np.testing.assert_allclose(answer["reliability"]["observed"], metrics.reliability.T, rtol=1e-10)


def ask(api, model, dataset, **request):
    return api.post(f"/v1/models/{model}/evaluate", json={"dataset": dataset} | request)


def expected(model, samples):
    answer = model.predict(samples.q, samples.dq, samples.ddq)
    return evaluate(samples.tau, answer.tau, answer.tau_std, answer.noise_std)


@pytest.fixture(scope="module")
def unseen(api):
    """A data set of the pendulum that no model was trained on."""
    return upload(api, stream(seed=7))["id"]


def test_figures_are_those_of_lipcore(api, trained, unseen):
    answer = ask(api, trained.name, unseen)
    assert answer.status_code == 200
    compare(answer.json(), expected(trained.model, stream(seed=7)))


def test_the_answer_says_what_was_compared(api, trained, unseen):
    answer = ask(api, trained.name, unseen, version=1).json()
    assert (answer["model"], answer["version"], answer["revision"]) == (trained.name, 1, 0)
    assert (answer["dataset"], answer["samples"], answer["samples_used"]) == (unseen, 80, 80)
    assert answer["joint_names"] == ["joint1", "joint2"]


def test_coverage_is_told_at_four_levels_and_as_a_reliability_curve(api, trained, unseen):
    answer = ask(api, trained.name, unseen).json()
    assert [interval["level"] for interval in answer["coverages"]] == [0.5, 0.8, 0.95, 0.99]
    assert answer["coverages"][2]["coverage"] == answer["coverage"]
    assert answer["coverages"][2]["interval_width"] == answer["interval_width"]
    widths = np.array([interval["interval_width"] for interval in answer["coverages"]])
    assert (np.diff(widths, axis=0) > 0).all()
    curve = answer["reliability"]
    np.testing.assert_allclose(curve["nominal"], [*np.arange(5, 100, 5) / 100, 0.99])
    assert np.shape(curve["observed"]) == (2, 20)
    assert [observed[-1] for observed in curve["observed"]] == answer["coverages"][3]["coverage"]
    assert (np.diff(curve["observed"]) >= 0).all()


def test_data_of_the_training_are_told_from_others(api, trained, unseen):
    assert ask(api, trained.name, trained.dataset).json()["in_training"] is True
    assert ask(api, trained.name, unseen).json()["in_training"] is False


@pytest.fixture
def panda(strict):
    """A data set of the shipped model's robot, larger than is evaluated at once."""
    return upload(strict, stream("panda", 120, motion="middle"))["id"]


def test_large_data_sets_are_thinned_evenly_and_that_is_said(strict, panda):
    answer = ask(strict, "panda-sim", panda).json()
    assert (answer["samples"], answer["samples_used"]) == (120, 50)
    assert answer["in_training"] is False
    service = service_of(strict)
    model = lipcore.load(service.files.version_folder(registry.find(service.database, "panda-sim", 1).folder))
    rows = np.round(np.arange(50) * 119 / 49).astype(np.int64)
    compare(answer, expected(model, stream("panda", 120, motion="middle").rows(rows)))


def test_the_shipped_model_is_good_and_honest(strict, panda):
    answer = ask(strict, "panda-sim", panda).json()
    assert max(answer["nmse"][:6]) < 0.1  # the last joint's torque hardly stands above the noise
    assert min(answer["coverage"]) > 0.8


def test_a_joint_whose_torque_does_not_vary_has_no_nmse(api, trained):
    samples = stream(seed=7)
    still = type(samples)(
        samples.joint_names,
        samples.t,
        samples.episode,
        samples.q,
        samples.dq,
        samples.ddq,
        samples.tau * [1, 0],
    )
    answer = ask(api, trained.name, upload(api, still)["id"]).json()
    assert answer["nmse"][0] > 0
    assert answer["nmse"][1] is None
    assert np.isfinite(answer["rmse"]).all()


def test_data_of_other_joints_are_refused(api, trained):
    other = upload(api, stream("asr-twodof"))["id"]
    said = error(ask(api, trained.name, other), 422, "invalid_request")
    assert said["detail"][0]["field"] == "dataset"
    assert "['joint1', 'joint2']" in said["message"]
    assert "['J1', 'J2']" in said["message"]


def test_data_of_another_torque_convention_are_refused(api, trained):
    other = upload(api, stream(), torque_convention="gravity_compensated")["id"]
    said = error(ask(api, trained.name, other), 422, "invalid_request")
    assert said["detail"][0]["field"] == "dataset"
    assert "gravity_compensated" in said["message"]
    assert "gravity_included" in said["message"]


def test_unknown_names_are_not_found(api, trained, unseen):
    error(ask(api, "nobody", unseen), 404, "not_found")
    error(ask(api, trained.name, "ds_nowhere"), 404, "not_found")
    error(ask(api, trained.name, unseen, version=99), 404, "not_found")


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({}, "dataset"),
        ({"dataset": 5}, "dataset"),
        ({"dataset": "x" * 41}, "dataset"),
        ({"dataset": "x", "version": 0}, "version"),
        ({"dataset": "x", "level": 0.9}, "level"),
    ],
)
def test_bad_requests_are_named(api, trained, body, field):
    answer = api.post(f"/v1/models/{trained.name}/evaluate", json=body)
    assert error(answer, 422, "invalid_request")["detail"][0]["field"] == field


def test_derived_samples_are_what_is_compared(api, trained):
    """A data set without velocities is evaluated on the derived ones."""
    fine = stream(samples=300, rate=50.0, seed=6)
    service = service_of(api)
    dataset = post(api, npz(**arrays(fine, "t", "q", "tau"))).json()
    kept = service.files.read_samples(dataset["id"], dataset["joint_names"], dataset["sha256"])
    assert len(kept) < len(fine)
    compare(ask(api, trained.name, dataset["id"]).json(), expected(trained.model, kept))
