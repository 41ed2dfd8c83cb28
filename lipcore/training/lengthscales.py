"""Lengthscales of each joint's residual, by the likelihood of samples given their neighbours among the others.

Neighbours are samples of other parts of the recording: what is near in time only is no evidence for a function of the
motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.distance import cdist
from threadpoolctl import threadpool_limits

from lipcore.data.samples import Array
from lipcore.kernels.fast.neighbours import Indices, likelihood_given_neighbours


@dataclass(frozen=True)
class LengthscaleOptions:
    """Size of the search for lengthscales.

    Tuned on random splits of the SARCOS test file (seed 2 with 3000 rows, 0 with 1000, 3 with 300), on `schunk`, and on
    a simulated UR10 and Kinova with `Dirt`.
    """

    max_rows: int = 2400
    """Max number of samples whose likelihood is computed."""
    min_before: int = 100
    """Number of samples before the first of them, if there are more than `max_rows`."""
    neighbours: tuple[int, ...] = (30, 45, 60)
    """Max number of neighbours of a sample: from each start, and in each search from the likeliest result, with the
    neighbours by the lengthscales of the one before."""
    first_iterations: int = 10
    """Max iterations from each start."""
    iterations: int = 40
    """Max iterations of a search."""
    prior_std: float = 1.5
    """Standard deviation of log ℓ around the log of a start, √D times the spread of the input."""
    starts: tuple[tuple[float, ...], ...] = ((1.0, 1.0, 1.0, 1.0), (0.2, 0.2, 0.2, 0.2), (1.0, 0.1, 0.1, 1.0))
    """Factors on the starts of the joint's own inputs q, dq, ddq and tanh. Friction depends on them the most."""
    noise_shares: tuple[float, ...] = (0.1, 0.5)
    """Shares of the noise in the variance of a start; the likelier is used."""
    min_gain_nats: float = 10.0
    """Min gain of the likelihood over noise alone. If it is less, the search ends early."""
    max_lengthscale: float = 4.0
    """Max lengthscale, in units of a start. Longer ones fit repeated motion better, but the residual then reaches far
    beyond it: on other motion, joint 4 of `schunk` had more error than with the arm alone."""
    max_variance: float = 10.0
    """Max s², in mean squares: far from all samples, a residual is of about usual size."""
    min_noise: float = 0.01
    """Min noise variance, in mean squares."""


OPTIONS = LengthscaleOptions()
UNUSED = 1e300
"""Lengthscale of an input that a residual does not depend on: derivatives by it are zero."""


@dataclass(frozen=True)
class Shape:
    """Hyperparameters of one joint's residual."""

    lengthscales: Array
    """ℓ, (D,), in the units of the inputs."""
    variance: float
    """s² (N·m)²."""
    noise: float
    """Variance of the noise of a sample of weight one, (N·m)²."""
    gain: float
    """Gain of the likelihood over noise alone, nats."""


def fit_shapes(
    inputs: Array,
    residual: Array,
    weights: Array,
    block: Indices,
    begin: Sequence[Array | None],
    arm_of: Indices | None = None,
) -> list[Shape]:
    """Return the most likely hyperparameters of each joint, given N samples.

    inputs: `residual_inputs`, (N, 4 n); residual: (N, n) N·m; weights: (N,), see
    `data.independence.recording_weights`; block: (N,), part of the recording; neighbours are of another one; begin:
    (n,), lengthscales of an earlier fit, (4 n,) each; one search improves them; arm_of: (n,), arm of each joint, all of
    one if None. A residual does not depend on other arms.
    """
    order = np.random.default_rng(0).permutation(len(inputs))
    arms = np.zeros(residual.shape[1], np.int64) if arm_of is None else arm_of
    width, out = np.maximum(inputs.std(axis=0), 1e-9), []
    with threadpool_limits(1):  # idle threads of BLAS would wait in a loop
        for joint, column in enumerate(residual[order].T):
            own = np.flatnonzero(arms == arms[joint])
            used = np.flatnonzero(np.tile(arms == arms[joint], inputs.shape[1] // len(arms)))
            spread = width[used] * np.sqrt(len(used))
            search = _Search(np.ascontiguousarray(inputs[order][:, used] / spread), weights[order], block[order])
            power, before = float(np.mean(column**2)) or 1.0, begin[joint]
            place = int(np.searchsorted(own, joint))
            starts = _starts(place, len(own)) if before is None else [np.log(before[used] / spread)]
            logs, gain = search.fit(column / np.sqrt(power), starts)
            variance, noise = (power * np.exp(logs[-2:])).tolist()
            lengthscales = np.full(inputs.shape[1], UNUSED)
            lengthscales[used] = np.exp(logs[:-2]) * spread
            out.append(Shape(lengthscales, variance, noise, gain))
    return out


def _starts(joint: int, n: int) -> list[Array]:
    """Return log ℓ of the starts for one of n joints, in units of the spread."""
    out = []
    for factors in OPTIONS.starts:
        logs = np.zeros(len(factors) * n)
        logs[joint::n] = np.log(factors)
        out.append(logs)
    return out


@dataclass(frozen=True)
class _Search:
    """Samples in random order: each has its neighbours among those before it."""

    inputs: Array
    weights: Array
    block: Indices

    @cached_property
    def rows(self) -> Indices:
        """Samples whose likelihood is computed: of many, the fewer the later, so that neighbours are near and far.

        If the motion repeats, and each has thousands of samples before it, all neighbours are near. Far from all
        samples, corrections of simulated arms then had up to three times the error of the arm alone.
        """
        size, most = len(self.block), OPTIONS.max_rows
        if size <= most:
            return np.arange(size)
        return np.unique(np.geomspace(OPTIONS.min_before, size - 1, most).astype(np.int64))

    def neighbours(self, log_lengthscales: Array, most: int) -> Indices:
        """Return the `most` nearest samples before each of `rows`, of other blocks; −1 where there are fewer."""
        scaled, size = self.inputs * np.exp(-log_lengthscales), len(self.block)
        count = min(most, max(1, size - 1))
        out = np.empty((len(self.rows), count), np.int64)
        for first in range(0, len(self.rows), 100):
            rows = self.rows[first : first + 100]
            distance = cdist(scaled[rows], scaled, "sqeuclidean")
            distance[self.block[rows, None] == self.block] = np.inf
            distance[np.arange(size) >= rows[:, None]] = np.inf
            nearest = np.argpartition(distance, count - 1, axis=1)[:, :count]
            unknown = ~np.isfinite(np.take_along_axis(distance, nearest, axis=1))
            nearest[unknown] = -1
            out[first : first + 100] = np.take_along_axis(nearest, np.argsort(unknown, axis=1, kind="stable"), axis=1)
        return out

    def fit(self, values: Array, starts: list[Array]) -> tuple[Array, float]:
        """Return log ℓ, log s² and log r of values, (N,), which have a mean square of one, and `Shape.gain`.

        starts: log ℓ, (D,) each. A single one is improved by one search.
        """
        size, rows = self.inputs.shape[1], self.rows
        bounds = [(-5.0, np.log(OPTIONS.max_lengthscale))] * size
        bounds += [(-12.0, np.log(OPTIONS.max_variance)), (np.log(OPTIONS.min_noise), 3.0)]
        width, slopes = np.array([*[OPTIONS.prior_std] * size, np.inf, np.inf]), np.empty(size + 2)

        def descend(starts: list[Array], most: int, iterations: int) -> tuple[float, Array]:
            neighbours = self.neighbours(starts[0][:size], most)

            def objective(logs: Array) -> tuple[float, Array]:
                arrays = self.inputs, values, self.weights, rows, neighbours, logs, slopes
                off = logs / width
                return likelihood_given_neighbours(*arrays) + 0.5 * float(off @ off), slopes + off / width

            start = min(starts, key=lambda each: objective(each)[0])
            options = {"maxiter": iterations, "maxcor": 30, "ftol": 1e-6}
            from scipy.optimize import minimize  # noqa: PLC0415 - serving does without it

            found = minimize(objective, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
            return float(found.fun), np.asarray(found.x)

        stages = [(most, OPTIONS.iterations) for most in OPTIONS.neighbours]
        if len(starts) == 1:
            stages = stages[-1:]
        else:
            stages[0] = (OPTIONS.neighbours[0], OPTIONS.first_iterations)
        ends = [
            descend([np.array([*logs, np.log(1 - share), np.log(share)]) for share in OPTIONS.noise_shares], *stages[0])
            for logs in starts
        ]
        value, logs = min(ends, key=lambda end: end[0])
        weights, squares = self.weights[rows], np.square(values[rows])
        variance = max(float(weights @ squares) / float(weights.sum()), 1e-12)
        alone = 0.5 * float(weights.sum()) * (1 + np.log(variance))
        for stage in stages[1:]:
            if alone - value >= OPTIONS.min_gain_nats:
                value, logs = descend([logs], *stage)
        return logs, alone - value
