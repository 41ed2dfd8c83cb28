"""How the error is spread over a recording: nMSE by episodes, or by ten stretches of as many samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.inference.evaluating import stretches
from tests.service.data import stream


def cut(counts):
    """Samples in episodes of so many rows, and a mean that is wrong by another amount in each."""
    samples = stream(samples=sum(counts), seed=3)
    episode = np.repeat(np.arange(len(counts)), counts)
    mean = samples.tau + 0.1 * (1 + episode[:, None]) * [1.0, -2.0]
    return replace(samples, episode=episode), mean


def test_episodes_are_stretches_and_share_one_denominator():
    samples, mean = cut([10, 20, 30, 40, 50])
    found = stretches(samples, mean)
    assert (found.kind, found.samples) == ("episodes", [10, 20, 30, 40, 50])
    errors = np.outer([1.0, 4.0], (0.1 * np.arange(1, 6)) ** 2)
    np.testing.assert_allclose(found.nmse, errors / samples.tau.var(axis=0)[:, None], rtol=1e-12)


def test_weighted_by_their_samples_they_average_to_the_nmse():
    for counts in ([10, 20, 30, 40, 50], [37, 66]):
        samples, mean = cut(counts)
        found = stretches(samples, mean)
        nmse = ((samples.tau - mean) ** 2).mean(axis=0) / samples.tau.var(axis=0)
        np.testing.assert_allclose(np.average(found.nmse, axis=1, weights=found.samples), nmse, rtol=1e-12)


@pytest.mark.parametrize(("counts", "kind", "stretched"), [([26] * 4, "equal", 10), ([3] * 201, "equal", 10)])
def test_too_few_or_too_many_episodes_make_ten_equal_stretches(counts, kind, stretched):
    found = stretches(*cut(counts))
    assert (found.kind, len(found.samples), sum(found.samples)) == (kind, stretched, sum(counts))
    assert max(found.samples) - min(found.samples) <= 1


def test_samples_fewer_than_stretches_are_one_each():
    samples, mean = cut([30])
    found = stretches(samples.rows(slice(0, 4)), mean[:4])
    assert found.samples == [1, 1, 1, 1]


def test_a_joint_whose_torque_does_not_vary_has_none():
    samples, mean = cut([10] * 5)
    found = stretches(replace(samples, tau=samples.tau * [1, 0]), mean)
    assert found.nmse[1] == [None] * 5
    assert None not in found.nmse[0]


def test_an_evaluation_tells_them(api, trained):
    answer = api.post(f"/v1/models/{trained.name}/evaluate", json={"dataset": trained.dataset}).json()
    said = answer["stretches"]
    assert (said["kind"], said["samples"]) == ("equal", [8] * 10)
    np.testing.assert_allclose(np.mean(said["nmse"], axis=1), answer["nmse"], rtol=1e-9)
