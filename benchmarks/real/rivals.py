"""Other methods, from the recording's mean to least squares with known kinematics.

Each method sees the training samples and the states of the test, not its torque. It chooses its constants on the last
quarter of the training samples; no constant was tuned on these robots.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from lipcore.data.samples import Array, Samples
from lipcore.robots.library import pinocchio
from lipcore.robots.urdf import RigidBody

SIGN_RAD_S = 0.05
"""Velocity scale of the smooth sign of velocity in the RBF's inputs."""
COULOMB_RAD_S = 0.02
"""Velocity scale of the smooth sign in Coulomb friction."""
MAX_RBF_ROWS = 1500
"""Max training rows of the RBF; more are thinned evenly, as its cost is cubic."""
LENGTHS = (0.5, 1.0, 2.0, 4.0, 8.0)
"""Length scales of the RBF, in standard deviations of an input times the square root of their number."""
RIDGES = tuple(10.0**power for power in range(-8, 1))
EM_STEPS = 30


class Intervals(NamedTuple):
    """Number of parameters that a method states intervals for, and of those that are infinite."""

    parameters: int
    infinite: int


class Forecast(NamedTuple):
    """A prediction of N measured torques: mean and standard deviation of a measurement, (N, n) each, N·m."""

    mean: Array
    std: Array
    intervals: Intervals | None = None
    """Intervals of parameters, if the method has any."""


Predict = Callable[[Samples, Samples], Forecast]
"""A function that learns from the first samples and predicts at the states of the second."""


def predict_mean(train: Samples, test: Samples) -> Forecast:
    """Predict the mean torque of the training samples."""
    shape = test.tau.shape
    return Forecast(np.broadcast_to(train.tau.mean(axis=0), shape), np.broadcast_to(train.tau.std(axis=0), shape))


def predict_rbf(train: Samples, test: Samples) -> Forecast:
    """Predict by ridge regression, k(x, x') = exp(−‖x − x'‖² / 2ℓ²), x = (q, dq, ddq, tanh(dq / 0.05)) standardised."""
    rows = np.linspace(0, len(train) - 1, min(len(train), MAX_RBF_ROWS)).round().astype(np.int64)
    train = train.rows(rows)
    inputs, centre, spread = _inputs(train), train.tau.mean(axis=0), _spread(train.tau)
    middle, scale = inputs.mean(axis=0), _spread(inputs)
    known, asked = (inputs - middle) / scale, (_inputs(test) - middle) / scale
    targets, early, late = (train.tau - centre) / spread, *_quarters(len(train))

    def fitted(length: float, x: Array, y: Array, at: Array) -> Iterable[Array]:
        values, vectors = np.linalg.eigh(_rbf(x, x, length))
        turned, features = vectors.T @ y, _rbf(at, x, length) @ vectors
        return (features @ (turned / (np.maximum(values, 0.0) + ridge * len(x))[:, None]) for ridge in RIDGES)

    squared = {
        (length, ridge): np.mean(np.square(answer - targets[late]), axis=0)
        for length in LENGTHS
        for ridge, answer in enumerate(fitted(length, known[early], targets[early], known[late]))
    }
    length, ridge = min(squared, key=lambda each: float(squared[each].mean()))
    answer = list(fitted(length, known, targets, asked))[ridge]
    return Forecast(centre + spread * answer, np.broadcast_to(spread * np.sqrt(squared[length, ridge]), answer.shape))


def _inputs(samples: Samples) -> Array:
    return np.concatenate([samples.q, samples.dq, samples.ddq, np.tanh(samples.dq / SIGN_RAD_S)], axis=1)


def _rbf(a: Array, b: Array, length: float) -> Array:
    distance = np.square(a).sum(axis=1)[:, None] + np.square(b).sum(axis=1) - 2 * a @ b.T
    return np.asarray(np.exp(-np.maximum(distance, 0.0) / (2 * length**2 * a.shape[1])))


def regressor(body: RigidBody, samples: Samples) -> Array:
    """Return Y (N, n, k) of τ = Y w.

    w: Pinocchio's inertial parameters of each body; rotor inertia, viscous and Coulomb friction, offset of each joint.
    """
    data, chain, order = body.model.createData(), np.argsort(body.order), list(body.order)
    rigid = pinocchio().computeJointTorqueRegressor
    states = zip(samples.q[:, chain], samples.dq[:, chain], samples.ddq[:, chain], strict=True)
    bodies = np.array([rigid(body.model, data, *state)[order] for state in states])
    sign = np.tanh(samples.dq / COULOMB_RAD_S)
    own = np.stack([samples.ddq, samples.dq, sign, np.ones_like(sign)], axis=2)[:, :, None, :]
    joints = own * np.eye(samples.n_joints)[:, :, None]
    return np.concatenate([bodies, joints.reshape(*sign.shape, -1)], axis=2)


def predict_least_squares(body: RigidBody, train: Samples, test: Samples) -> Forecast:
    """Predict by ridge regression on `regressor`, joints weighted by their residuals of an unweighted fit."""
    features, (early, late) = regressor(body, train), _quarters(len(train))
    unit = np.sqrt(np.square(features).mean(axis=(0, 1)))
    features = features / np.where(unit > 0, unit, 1.0)

    def solved(rows: slice, std: Array, ridge: float) -> Array:
        wide = (features[rows] / std[:, None]).reshape(-1, len(unit))
        left = wide.T @ wide
        left[np.diag_indices_from(left)] += ridge * np.trace(left) / len(unit)
        return np.asarray(np.linalg.solve(left, wide.T @ (train.tau[rows] / std).ravel()), dtype=np.float64)

    def weighted(rows: slice, ridge: float) -> Array:
        residual = train.tau[rows] - features[rows] @ solved(rows, _spread(train.tau), ridge)
        return solved(rows, _spread(residual), ridge)

    def errors(ridge: float) -> Array:
        return train.tau[late] - features[late] @ weighted(early, ridge)

    ridge = min(RIDGES, key=lambda each: float(np.mean(np.square(errors(each) / _spread(train.tau)))))
    weights = weighted(slice(None), ridge) / np.where(unit > 0, unit, 1.0)
    mean = regressor(body, test) @ weights
    std = np.sqrt(np.mean(np.square(errors(ridge)), axis=0))
    return Forecast(mean, np.broadcast_to(std, mean.shape))


def predict_bayesian(body: RigidBody, train: Samples, test: Samples) -> Forecast:
    """Predict by Bayesian linear regression on `regressor`.

    EM finds the prior scale of each parameter and the noise of each joint. The rows of a second count as one in the
    posterior; the noise is the residuals' variance over the degrees of freedom of all rows.
    """
    features, tau = regressor(body, train), train.tau
    rows, size = len(features), features.shape[2]
    unit = np.sqrt(np.square(features).mean(axis=(0, 1))) + 1e-12
    features = np.where(unit > 1e-9, features / unit, 0.0)
    gram = np.einsum("tjp,tjq->jpq", features, features, optimize=True)
    moment = np.einsum("tjp,tj->jp", features, tau)
    weight = min(1.0, float(np.median(np.diff(train.t))))
    noise, scale = 0.01 * tau.var(axis=0), np.full(size, tau.std(axis=0).mean() ** 2)
    for _ in range(EM_STEPS):
        precision = weight / noise
        covariance = np.linalg.inv(np.einsum("j,jpq->pq", precision, gram) + np.diag(1 / scale))
        weights = covariance @ (precision @ moment)
        used = precision * np.einsum("pq,jqp->j", covariance, gram)
        squared = np.square(tau - features @ weights).sum(axis=0)
        noise = squared / np.maximum(rows - used, 0.1 * rows)
        scale = np.maximum(weights**2 + np.diag(covariance), 1e-10)
    asked = np.where(unit > 1e-9, regressor(body, test) / unit, 0.0)
    variance = np.einsum("tjp,pq,tjq->tj", asked, covariance, asked, optimize=True)
    return Forecast(asked @ weights, np.sqrt(variance + noise))


def _quarters(rows: int) -> tuple[slice, slice]:
    """Return the first three quarters and the last quarter."""
    return slice(0, 3 * rows // 4), slice(3 * rows // 4, rows)


def _spread(values: Array) -> Array:
    """Return the standard deviation of each column, 1 if it is constant."""
    std = values.std(axis=0)
    return np.where(std > 0, std, 1.0)
