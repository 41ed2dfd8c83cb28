"""Tests of the residual: its compiled numbers, and the likelihood by which its lengthscales are found."""

import numpy as np
import pytest
from scipy.linalg import cho_solve, cholesky

from lipcore.data.motion import Motion
from lipcore.kernels.fast.neighbours import likelihood_given_neighbours
from lipcore.kernels.residual import JointResidual, ResidualKernel, residual_inputs
from tests.lipcore.oracles import central_difference


def random_residual(n: int, centres: list[int], rows: list[int]) -> ResidualKernel:
    rng, joints = np.random.default_rng(0), []
    for count, size in zip(centres, rows, strict=True):
        root = 0.1 * np.tril(rng.normal(size=(size, size)))
        lengths = rng.uniform(2.0, 4.0, 4 * n)
        places = rng.normal(size=(count, 4 * n)).astype(np.float32).astype(np.float64)
        joints.append(
            JointResidual(
                lengths, places, rng.normal(size=count), root, 2.0, 0.4, rng.normal(size=max(size, count // 2)), 0.7
            )
        )
    return ResidualKernel(joints)


@pytest.mark.parametrize(("centres", "rows"), [([37, 8, 0], [37, 8, 0]), ([100, 1, 5], [33, 1, 0])])
def test_compiled_numbers_match_the_formula(centres, rows):
    n, rng = 3, np.random.default_rng(1)
    kernel, motion = random_residual(n, centres, rows), Motion(*rng.normal(size=(3, 7, n)))
    mean, beyond, features = kernel.mean(motion), kernel.beyond(motion), kernel.features(motion)
    inputs = residual_inputs(motion)
    for j, each in enumerate(kernel.joints):
        apart = (inputs / each.lengthscales)[:, None] - each.centres
        near = np.exp(-0.5 * np.square(apart).sum(axis=-1))
        np.testing.assert_allclose(mean[:, j], near @ each.weights, rtol=1e-10, atol=1e-11)
        expected = near[:, : len(each.root)] @ each.root.T
        own = kernel.of_joint(j)
        np.testing.assert_allclose(features[:, j, own], expected, rtol=1e-10, atol=1e-11)
        assert not np.delete(features[:, j], own, axis=1).any()
        left = np.maximum(2.0 - np.square(expected).sum(axis=1), 0.0)
        left *= 1 - 0.4 * np.square(near.max(axis=1, initial=0.0))
        np.testing.assert_allclose(beyond[:, j], left, rtol=1e-10, atol=1e-11)
    own = kernel.variance({}, motion).diagonal(axis1=1, axis2=2)
    np.testing.assert_allclose(own, beyond + np.square(features).sum(axis=2))
    np.testing.assert_allclose(kernel.symmetric_gram({}, motion).diagonal(), own.reshape(-1))


def test_fast_kernel_has_the_first_centres_and_all_features():
    rng = np.random.default_rng(2)
    kernel, motion = random_residual(2, [100, 5], [33, 0]), Motion(*rng.normal(size=(3, 4, 2)))
    np.testing.assert_allclose(kernel.fast.features(motion), kernel.features(motion), rtol=1e-12)
    for j, each in enumerate(kernel.joints):
        apart = (residual_inputs(motion) / each.lengthscales)[:, None] - each.centres[: len(each.fast_weights)]
        near = np.exp(-0.5 * np.square(apart).sum(axis=-1))
        np.testing.assert_allclose(kernel.fast.mean(motion)[:, j], near @ each.fast_weights, rtol=1e-10, atol=1e-11)
        left = (2.0 - np.square(kernel.features(motion)[:, j]).sum(axis=1)).clip(0.0)
        expected = left * (1 - 0.7 * np.square(near.max(axis=1)))
        np.testing.assert_allclose(kernel.fast.beyond(motion)[:, j], expected, rtol=1e-10, atol=1e-11)


def test_no_torque_far_from_all_centres():
    kernel = random_residual(2, [20, 20], [20, 20])
    far = Motion(np.full((1, 2), 1e6), *np.zeros((2, 1, 2)))
    np.testing.assert_allclose(kernel.mean(far), 0.0, atol=1e-30)
    np.testing.assert_allclose(kernel.beyond(far), 2.0)


def dense(inputs, values, weights, logs) -> float:
    """Return −log p of the values without its constant, by the Cholesky factor of their whole covariance."""
    scaled = inputs * np.exp(-logs[:-2])
    squares = np.square(scaled[:, None] - scaled).sum(axis=-1)
    gram = np.exp(logs[-2] - 0.5 * squares) + np.diag(np.exp(logs[-1]) / weights)
    root = cholesky(gram, lower=True)
    return float(0.5 * values @ cho_solve((root, True), values) + np.log(root.diagonal()).sum())


def neighbour_case(size=25, inputs=4):
    rng = np.random.default_rng(0)
    logs = np.concatenate([rng.normal(0.5, 0.2, inputs), [0.3, -1.5]])
    return rng.normal(size=(size, inputs)), rng.normal(size=size), np.ones(size), logs


def test_likelihood_given_all_samples_before_is_exact():
    inputs, values, weights, logs = neighbour_case()
    rows = np.arange(len(values))
    before = np.where(rows < rows[:, None], rows, -1)
    found = likelihood_given_neighbours(inputs, values, weights, rows, before, logs, np.empty(len(logs)))
    assert found == pytest.approx(dense(inputs, values, weights, logs), rel=1e-10)


def test_slopes_of_the_likelihood_given_few_neighbours():
    inputs, values, weights, logs = neighbour_case()
    weights = np.random.default_rng(2).uniform(0.2, 1.0, len(values))
    rows, slopes = np.arange(6, len(values)), np.empty(len(logs))
    few = np.stack([np.random.default_rng(row).permutation(row)[:5] for row in rows])
    few[::3, 3:] = -1

    def value(at):
        return likelihood_given_neighbours(inputs, values, weights, rows, few, at, np.empty(len(logs)))

    likelihood_given_neighbours(inputs, values, weights, rows, few, logs, slopes)
    expected = [central_difference(lambda step, way=way: value(logs + step * way), 1e-3) for way in np.eye(len(logs))]
    np.testing.assert_allclose(slopes, expected, rtol=1e-7, atol=1e-8)


def test_likelihood_of_a_sample_without_neighbours_is_that_of_its_prior():
    inputs, values, weights, logs = neighbour_case(2)
    weights[1] = 0.5
    found = likelihood_given_neighbours(
        inputs, values, weights, np.array([1]), np.array([[-1]]), logs, np.empty(len(logs))
    )
    variance = np.exp(logs[-2]) + np.exp(logs[-1])
    assert found == pytest.approx(0.25 * (np.log(variance) + values[1] ** 2 / variance))
