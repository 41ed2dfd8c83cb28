"""How large masses, rotor inertias and friction are expected to be, and the noise: what the evidence says.

Around an optimum the torque is linear in all unknowns u = (w, θ), so the evidence of noise σ and prior deviations s,

    −log p(τ | σ, s) = Σ_j N log σ_j + ½ log |I + S A S| + ½ (y − Φ û)ᵀ R⁻¹ (y − Φ û) + ½ |d|²,    û = μ + S d,

costs no more than a factorisation of A = Φᵀ R⁻¹ Φ. The logarithm of a deviation is a sum: of one number for the kind of
parameter (mass, first moment, inertia, rotor, each term of friction), and for a body's parameters of one for the body,
since a wrist is lighter than a shoulder. Where a recording tells nothing of some masses, they stay as small as their
likes; taken for as large as a shoulder's, they would let motion that was not seen go wrong.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from lipcore.arm.problem import NOISE_WIDTH, SCALE_WIDTH, Point, Problem, root_of
from lipcore.data.samples import Array
from lipcore.kernels.arm_prior import KINDS
from lipcore.kernels.compiled.arm import PARAMETERS

FARTHEST = 8.0
ITERATIONS = 60
BODY_KINDS = 3


@dataclass(frozen=True)
class Scaled:
    """problem: with the deviations of largest evidence; sigma: (n,) noise std, N·m; value: −log evidence, nats."""

    problem: Problem
    sigma: Array
    value: float


def rescale(problem: Problem, point: Point) -> Scaled:
    """Maximise the evidence over noise and prior deviations around a point (eq. 20 of docs/method.md).

    Raise LinAlgError where there is no evidence.
    """
    from scipy.optimize import minimize  # noqa: PLC0415 - serving does without it

    n, k = problem.n_joints, len(problem.scale)
    evidence = _Evidence.around(problem, point)
    parts = _parts(n, k)
    noise, floor = np.log(problem.noise), np.log(problem.floor)
    width = np.full(parts.shape[1], SCALE_WIDTH)
    width[: BODY_KINDS + n + 1] = problem.scale_width

    def negative(flat: Array) -> tuple[float, Array]:
        log_noise, shares = flat[:n], flat[n:]
        value, by_noise, by_scale = evidence(log_noise, parts @ shares)
        off = (log_noise - noise) / NOISE_WIDTH
        value += 0.5 * float(off @ off + np.sum((shares / width) ** 2))
        return value, np.concatenate([by_noise + off / NOISE_WIDTH, parts.T @ by_scale + shares / width**2])

    start = np.concatenate([np.log(point.sigma), np.zeros(parts.shape[1])])
    bounds = [(low, None) for low in floor.tolist()] + [(-FARTHEST, FARTHEST)] * parts.shape[1]
    best = minimize(negative, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": ITERATIONS})
    scale = problem.scale * np.exp(parts @ best.x[n:])
    return Scaled(replace(problem, scale=scale), np.exp(best.x[:n]), float(best.fun))


@dataclass(frozen=True)
class _Evidence:
    """Sums over samples: of each joint the Gram matrix (k + g, k + g) and right-hand side of all features, Σ τ²; the
    prior's mean and deviations; how many of them are scaled; counts: (n,)."""

    grams: Array
    rights: Array
    squares: Array
    counts: Array
    mean: Array
    std: Array
    scaled: int

    @classmethod
    def around(cls, problem: Problem, point: Point) -> _Evidence:
        plain = point.features / problem.scale
        both = np.concatenate([plain, problem.shapes(point)], axis=2)
        steps = np.zeros(0) if problem.expected is None else problem.expected.step(point.geometry)
        widths = np.zeros(0) if problem.expected is None else problem.expected.widths
        weighed = both * problem.counts[:, :, None]
        return cls(
            np.stack([weighed[:, j].T @ both[:, j] for j in range(problem.n_joints)]),
            np.stack([weighed[:, j].T @ problem.tau[:, j] for j in range(problem.n_joints)]),
            (problem.counts * problem.tau**2).sum(0),
            problem.counts.sum(0),
            np.concatenate([problem.centre, steps]),
            np.concatenate([problem.scale, widths]),
            len(problem.scale),
        )

    def __call__(self, log_noise: Array, log_factor: Array) -> tuple[float, Array, Array]:
        """−log evidence and its derivatives by log σ (n,) and by the logarithms of the scaled deviations (k,)."""
        std = self.std.copy()
        std[: self.scaled] *= np.exp(log_factor)
        precision = np.exp(-2 * log_noise)
        gram = np.tensordot(precision, self.grams, 1)
        right = std * (precision @ self.rights - gram @ self.mean)
        total = gram * np.outer(std, std)
        total.flat[:: len(total) + 1] += 1.0
        lower = root_of(total)
        root = solve_triangular(lower, np.eye(len(lower)), lower=True, check_finite=False)
        covariance = root.T @ root
        deviation = covariance @ right
        weights = self.mean + std * deviation
        squares = self.squares - 2 * self.rights @ weights + np.einsum("k,jkl,l->j", weights, self.grams, weights)
        value = 0.5 * (precision @ squares + deviation @ deviation) + np.log(lower.diagonal()).sum()
        spread = covariance * np.outer(std, std)
        used = np.einsum("kl,jkl->j", spread, self.grams)
        by_noise = self.counts - precision * (squares + used)
        by_scale = 1.0 - deviation**2 - covariance.diagonal()
        return float(value + self.counts @ log_noise), by_noise, by_scale[: self.scaled]


def _parts(n: int, k: int) -> Array:
    """Which numbers each deviation's logarithm is the sum of: (k, 3 + n + 1 + terms of friction)."""
    terms = (k - (PARAMETERS + 1) * n) // n
    out = np.zeros((k, BODY_KINDS + n + 1 + terms))
    for body in range(n):
        rows = slice(PARAMETERS * body, PARAMETERS * (body + 1))
        out[rows, :BODY_KINDS] = np.eye(BODY_KINDS)[list(KINDS)]
        out[rows, BODY_KINDS + body] = 1.0
    first = PARAMETERS * n
    out[first : first + n, BODY_KINDS + n] = 1.0
    out[first + n :, BODY_KINDS + n + 1 :] = np.tile(np.eye(terms), (n, 1))
    return out
