"""Evaluation: lipcore's metrics on the samples of a data set."""

from dataclasses import replace

import numpy as np
import pytest

import lipcore
from lipcore.data.metrics import evaluate
from service.models import registry
from service.models.evaluation import stretches
from tests.service.data import error, service_of, stream, upload

FIGURES = ("nmse", "rmse", "coverage", "nlpd")


def assert_metrics(answer, metrics):
    for name in FIGURES:
        np.testing.assert_allclose(np.array(answer[name], dtype=float), getattr(metrics, name), rtol=1e-10)
    np.testing.assert_allclose(answer["interval_width"], metrics.width, rtol=1e-10)
    assert answer["level"] == metrics.level == 0.95
    for row, interval in enumerate(answer["coverages"]):
        np.testing.assert_allclose(interval["coverage"], metrics.coverages[row], rtol=1e-10)
        np.testing.assert_allclose(interval["interval_width"], metrics.widths[row], rtol=1e-10)
    np.testing.assert_allclose(answer["reliability"]["observed"], metrics.reliability.T, rtol=1e-10)


def post_evaluation(api, model, dataset, **request):
    return api.post(f"/v1/models/{model}/evaluate", json={"dataset": dataset} | request)


def expected(model, samples):
    answer = model.predict(samples.q, samples.dq, samples.ddq)
    return evaluate(samples.tau, *answer.interval)


@pytest.fixture(scope="module")
def unseen_dataset(api):
    """A data set of the pendulum that no model was trained on."""
    return upload(api, stream(seed=7))["id"]


def test_metrics_equal_lipcore(api, trained, unseen_dataset):
    answer = post_evaluation(api, trained.name, unseen_dataset)
    assert answer.status_code == 200
    assert_metrics(answer.json(), expected(trained.model, stream(seed=7)))


def test_answer_describes_the_comparison(api, trained, unseen_dataset):
    answer = post_evaluation(api, trained.name, unseen_dataset, version=1).json()
    assert (answer["model"], answer["version"], answer["revision"]) == (trained.name, 1, 0)
    assert (answer["dataset"], answer["samples"], answer["samples_used"]) == (unseen_dataset, 80, 80)
    assert answer["joint_names"] == ["joint1", "joint2"]
    assert (answer["stretches"]["kind"], answer["stretches"]["samples"]) == ("equal", [8] * 10)
    np.testing.assert_allclose(np.mean(answer["stretches"]["nmse"], axis=1), answer["nmse"], rtol=1e-9)


@pytest.fixture
def panda(strict):
    """A data set of the shipped model's robot, larger than one evaluation."""
    return upload(strict, stream("panda", 120, motion="middle"))["id"]


def test_large_data_set_is_thinned_evenly_with_a_note(strict, panda):
    answer = post_evaluation(strict, "panda-sim", panda).json()
    assert (answer["samples"], answer["samples_used"]) == (120, 50)
    assert answer["in_training"] is False
    service = service_of(strict)
    model = lipcore.load(service.files.version_folder(registry.find(service.database, "panda-sim", 1).folder))
    rows = np.round(np.arange(50) * 119 / 49).astype(np.int64)
    assert_metrics(answer, expected(model, stream("panda", 120, motion="middle").rows(rows)))


def test_shipped_model_is_accurate_and_calibrated(strict, panda):
    answer = post_evaluation(strict, "panda-sim", panda).json()
    assert max(answer["nmse"][:6]) < 0.1  # the last joint's torque is barely above the noise
    assert min(answer["coverage"]) > 0.8


@pytest.mark.parametrize(
    ("robot", "convention", "words"),
    [
        ("asr-twodof", "gravity_included", ("joint1, joint2", "J1, J2")),
        ("double-pendulum", "gravity_compensated", ("gravity_compensated", "gravity_included")),
    ],
)
def test_data_of_other_joints_or_torques_are_rejected(api, trained, robot, convention, words):
    other = upload(api, stream(robot), torque_convention=convention)["id"]
    problem = error(post_evaluation(api, trained.name, other), 422, "invalid_request")
    assert problem["detail"][0]["field"] == "dataset"
    assert all(word in problem["message"] for word in words)


def samples_with_errors(counts):
    """Return samples in episodes of these lengths, and a mean with another error in each episode."""
    samples = stream(samples=sum(counts), seed=3)
    episode = np.repeat(np.arange(len(counts)), counts)
    mean = samples.tau + 0.1 * (1 + episode[:, None]) * [1.0, -2.0]
    return replace(samples, episode=episode), mean


def test_episodes_are_stretches_with_one_denominator():
    samples, mean = samples_with_errors([10, 20, 30, 40, 50])
    result = stretches(samples, mean)
    assert (result.kind, result.samples) == ("episodes", [10, 20, 30, 40, 50])
    errors = np.outer([1.0, 4.0], (0.1 * np.arange(1, 6)) ** 2)
    np.testing.assert_allclose(result.nmse, errors / samples.tau.var(axis=0)[:, None], rtol=1e-12)


@pytest.mark.parametrize("counts", [[26] * 4, [3] * 201])
def test_too_few_or_many_episodes_become_ten_equal_stretches(counts):
    result = stretches(*samples_with_errors(counts))
    assert (result.kind, len(result.samples), sum(result.samples)) == ("equal", 10, sum(counts))
    assert max(result.samples) - min(result.samples) <= 1
