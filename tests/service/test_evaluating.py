"""Evaluation: figures of lipcore's metrics on the samples of a data set."""

from dataclasses import replace

import numpy as np
import pytest

import lipcore
from lipcore.data.metrics import evaluate
from service.models import registry
from service.models.evaluation import stretches
from tests.service.data import error, service_of, stream, upload

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
    return evaluate(samples.tau, *answer.interval)


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
    assert (answer["stretches"]["kind"], answer["stretches"]["samples"]) == ("equal", [8] * 10)
    np.testing.assert_allclose(np.mean(answer["stretches"]["nmse"], axis=1), answer["nmse"], rtol=1e-9)


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


@pytest.mark.parametrize(
    ("robot", "convention", "words"),
    [
        ("asr-twodof", "gravity_included", ("joint1, joint2", "J1, J2")),
        ("double-pendulum", "gravity_compensated", ("gravity_compensated", "gravity_included")),
    ],
)
def test_data_of_other_joints_or_torques_are_refused(api, trained, robot, convention, words):
    other = upload(api, stream(robot), torque_convention=convention)["id"]
    problem = error(ask(api, trained.name, other), 422, "invalid_request")
    assert problem["detail"][0]["field"] == "dataset"
    assert all(word in problem["message"] for word in words)


def cut(counts):
    """Samples in episodes of so many rows, and a mean that is wrong by another amount in each."""
    samples = stream(samples=sum(counts), seed=3)
    episode = np.repeat(np.arange(len(counts)), counts)
    mean = samples.tau + 0.1 * (1 + episode[:, None]) * [1.0, -2.0]
    return replace(samples, episode=episode), mean


def test_episodes_are_stretches_and_share_one_denominator():
    samples, mean = cut([10, 20, 30, 40, 50])
    result = stretches(samples, mean)
    assert (result.kind, result.samples) == ("episodes", [10, 20, 30, 40, 50])
    errors = np.outer([1.0, 4.0], (0.1 * np.arange(1, 6)) ** 2)
    np.testing.assert_allclose(result.nmse, errors / samples.tau.var(axis=0)[:, None], rtol=1e-12)


@pytest.mark.parametrize("counts", [[26] * 4, [3] * 201])
def test_too_few_or_too_many_episodes_make_ten_equal_stretches(counts):
    result = stretches(*cut(counts))
    assert (result.kind, len(result.samples), sum(result.samples)) == ("equal", 10, sum(counts))
    assert max(result.samples) - min(result.samples) <= 1
