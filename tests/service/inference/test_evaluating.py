"""Evaluation: lipcore's metrics on the samples of a data set."""

from dataclasses import replace

import numpy as np
import pytest

import lipcore
from lipcore.data.metrics import evaluate
from service.models import registry
from service.models.evaluation import stretches
from tests.service.data import error, service_of, stream, upload


def assert_metrics(answer, metrics):
    assert answer["level"] == metrics.level == 0.95
    intervals = answer["coverages"]
    for found, values in (
        *((answer[name], getattr(metrics, name)) for name in ("nmse", "rmse", "coverage", "nlpd")),
        (answer["interval_width"], metrics.width),
        ([each["coverage"] for each in intervals], metrics.coverages),
        ([each["interval_width"] for each in intervals], metrics.widths),
        (answer["reliability"]["observed"], metrics.reliability.T),
    ):
        np.testing.assert_allclose(np.array(found, dtype=float), values, rtol=1e-10)


def post_evaluation(api, model, dataset, **request):
    return api.post(f"/v1/models/{model}/evaluate", json={"dataset": dataset} | request)


def expected(model, samples):
    answer = model.predict(samples.q, samples.dq, samples.ddq)
    return evaluate(samples.tau, *answer.interval)


def test_metrics_equal_lipcore_and_the_answer_describes_the_comparison(api, trained):
    dataset = upload(api, stream(seed=7))["id"]  # no model was trained on it
    serving, first = (post_evaluation(api, trained.name, dataset, **chosen) for chosen in ({}, {"version": 1}))
    answer = first.json()
    assert (serving.status_code, serving.json()) == (200, answer)
    assert_metrics(answer, expected(trained.model, stream(seed=7)))
    assert (answer["model"], answer["version"], answer["revision"]) == (trained.name, 1, 0)
    assert (answer["dataset"], answer["samples"], answer["samples_used"]) == (dataset, 80, 80)
    assert answer["joint_names"] == ["joint1", "joint2"]
    assert (answer["stretches"]["kind"], answer["stretches"]["samples"]) == ("equal", [8] * 10)
    np.testing.assert_allclose(np.mean(answer["stretches"]["nmse"], axis=1), answer["nmse"], rtol=1e-9)


def test_large_data_set_is_thinned_evenly_and_the_shipped_model_predicts_it(strict):
    samples = stream("panda", 120, motion="middle")
    answer = post_evaluation(strict, "panda-sim", upload(strict, samples)["id"]).json()
    assert (answer["samples"], answer["samples_used"], answer["in_training"]) == (120, 50, False)
    service = service_of(strict)
    model = lipcore.load(service.files.version_folder(registry.find(service.database, "panda-sim", 1).folder))
    rows = np.round(np.arange(50) * 119 / 49).astype(np.int64)
    assert_metrics(answer, expected(model, samples.rows(rows)))
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
