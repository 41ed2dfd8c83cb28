"""Prior standard deviations of masses, rotor inertias and friction, by the evidence.

Around an optimum the torque is linear in all unknowns u = (w, θ). So the evidence of prior deviations s,

    −log p(τ | s) = Σ_j N_j log σ_j + ½ log |I + S A S| + ½ (y − Φ û)ᵀ R⁻¹ (y − Φ û) + ½ |d|²,    û = μ + S d,

costs no more than a factorisation of A = Φᵀ R⁻¹ Φ. The noise σ is fixed to that of the residuals. The logarithm of a
body's deviation is a sum of one number for the kind of parameter (mass, first moment, inertia) and one for the body,
since a wrist is lighter than a shoulder. All rotors share one number. Each friction term of each joint has its own
number, near the mean of all joints. Every deviation has limits: if few samples do not determine it, the max of the
evidence is at zero or at infinity.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from lipcore.arm.problem import Point, Problem, root_of
from lipcore.data.samples import Array
from lipcore.kernels.arm_prior import KINDS
from lipcore.kernels.drive.terms import BASE_TERMS
from lipcore.kernels.fast.arm import PARAMETERS


@dataclass(frozen=True)
class ScaleOptions:
    """Limits of prior standard deviations."""

    max_log_share: float = 2.5
    """Max absolute logarithm of the shares of masses and rotors: a factor of 12 either way."""
    min_friction_share: float = 0.1
    """Min standard deviation of a friction torque, as a share of its joint's root mean square torque, which is the
    max."""
    min_kind_share: float = 1e-3
    """The same for the kinds of friction that a recording has to support."""
    unused_share: float = 1e-6
    """The same for kinds that a joint does not have, and its max."""
    pooling_width: float = 0.7
    """Prior standard deviation of the logarithm of a joint's friction deviation around the mean of all joints."""
    min_count: float = 40.0
    """Min measurements of a joint in the evidence of deviations, even if fewer rows of a recording are independent.

    With few measurements, friction and masses appear to be zero and count as noise. With all rows, masses follow
    lasting errors. Tuned on recordings of seven arms, each held out in turn: with a URDF, 30 and 60 differ by 2 %, and
    no such limit is 25 % worse (geometric mean of nMSE). Without a URDF all three are within 8 %.
    """


OPTIONS = ScaleOptions()
BODY_KINDS = 3


@dataclass(frozen=True)
class ScaleFit:
    """Result of `rescale`."""

    problem: Problem
    """The problem with the deviations of max evidence."""
    point: Point
    """The same geometry with these deviations, and with the noise of its residuals."""
    value: float
    """−log evidence of the deviations, nats."""


def rescale(problem: Problem, point: Point) -> ScaleFit:
    """Maximise the evidence over prior deviations around a point (eq. 20 of docs/method.md).

    Raise LinAlgError if the evidence cannot be computed.
    """
    from scipy.optimize import minimize  # noqa: PLC0415 - serving does without it

    n, k = problem.n_joints, len(problem.scale)
    point = problem.with_noise(problem.at(point.geometry, point.sigma))
    evidence = _Evidence.around(problem, point)
    parts, masses = _parts(n, k), BODY_KINDS + n + 1
    frictions = k - problem.bodies
    least = np.full(len(problem.drive.terms), np.log(OPTIONS.min_kind_share))
    least[: len(BASE_TERMS)] = np.log(OPTIONS.min_friction_share)
    bounds = [(-OPTIONS.max_log_share, OPTIONS.max_log_share)] * masses
    none, used = float(np.log(OPTIONS.unused_share)), problem.used
    bounds += [
        (float(each), 0.0) if there else (none, none)
        for each, there in zip(np.tile(least, n), used.reshape(-1), strict=True)
    ]
    width = np.repeat([problem.scale_width, OPTIONS.pooling_width], [masses, frictions])

    def negative(shares: Array) -> tuple[float, Array]:
        value, slopes = evidence(parts @ shares)
        friction = shares[masses:].reshape(n, -1)
        usual = np.where(used, friction, 0.0).sum(axis=0) / np.maximum(used.sum(axis=0), 1)
        apart = np.where(used, friction - usual, 0.0)
        off = np.concatenate([shares[:masses], apart.reshape(-1)]) / width
        return value + 0.5 * float(off @ off), parts.T @ slopes + off / width

    start = np.linalg.lstsq(parts, np.log(problem.scale / problem.unit))[0]
    start = np.clip(start, *np.transpose(bounds))
    best = minimize(negative, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 60})
    problem = replace(problem, scale=problem.unit * np.exp(parts @ best.x))
    return ScaleFit(problem, problem.with_noise(problem.at(point.geometry, point.sigma)), float(best.fun))


def raise_counts(counts: Array) -> Array:
    """Return the weights of torques in the evidence of deviations: at least `min_count` per joint on average."""
    return np.asarray(counts * max(1.0, OPTIONS.min_count / float(counts.sum(0).mean())))


@dataclass(frozen=True)
class _Evidence:
    """Evidence of prior deviations, from sums over samples in units of the noise."""

    gram: Array
    """Gram matrix of all features, (k + g, k + g)."""
    right: Array
    """Right-hand side, (k + g,)."""
    squares: float
    """Σ τ²."""
    log_noise: float
    """Σ N_j log σ_j."""
    mean: Array
    """Prior mean, (k + g,)."""
    std: Array
    """Prior standard deviations, (k + g,)."""
    scaled: int
    """Number of the first standard deviations, which `log_factor` scales."""

    @classmethod
    def around(cls, problem: Problem, point: Point) -> _Evidence:
        both = np.concatenate([point.features / problem.scale, problem.shapes(point)], axis=2)
        steps = np.zeros(0) if problem.expected is None else problem.expected.step(point.geometry)
        widths = np.zeros(0) if problem.expected is None else problem.expected.widths
        counts = raise_counts(problem.counts)
        weight = np.sqrt(counts) / point.sigma
        flat, target = (both * weight[:, :, None]).reshape(-1, both.shape[2]), (problem.tau * weight).reshape(-1)
        return cls(
            flat.T @ flat,
            flat.T @ target,
            float(target @ target),
            float(counts.sum(0) @ np.log(point.sigma)),
            np.concatenate([problem.centre, steps]),
            np.concatenate([problem.unit, widths]),
            len(problem.scale),
        )

    def __call__(self, log_factor: Array) -> tuple[float, Array]:
        """Return −log evidence and its derivatives by the logarithms of the scaled deviations, (k,).

        log_factor: (k,), logarithm of the deviations relative to those of unit weights.
        """
        std = self.std.copy()
        std[: self.scaled] *= np.exp(log_factor)
        total = self.gram * np.outer(std, std)
        total.flat[:: len(total) + 1] += 1.0
        lower = root_of(total)
        root = solve_triangular(lower, np.eye(len(lower)), lower=True, check_finite=False)
        deviation = root.T @ (root @ (std * (self.right - self.gram @ self.mean)))
        weights = self.mean + std * deviation
        squares = self.squares - 2 * self.right @ weights + weights @ self.gram @ weights
        value = 0.5 * (squares + deviation @ deviation) + np.log(lower.diagonal()).sum() + self.log_noise
        slopes = 1.0 - deviation**2 - np.square(root).sum(0)
        return float(value), slopes[: self.scaled]


def _parts(n: int, k: int) -> Array:
    """Return the matrix of the numbers that sum to each deviation's logarithm, (k, 3 + n + 1 + friction's weights)."""
    first = (PARAMETERS + 1) * n
    out = np.zeros((k, BODY_KINDS + n + 1 + k - first))
    for body in range(n):
        rows = slice(PARAMETERS * body, PARAMETERS * (body + 1))
        out[rows, :BODY_KINDS] = np.eye(BODY_KINDS)[list(KINDS)]
        out[rows, BODY_KINDS + body] = 1.0
    out[PARAMETERS * n : first, BODY_KINDS + n] = 1.0
    out[first:, BODY_KINDS + n + 1 :] = np.eye(k - first)
    return out
