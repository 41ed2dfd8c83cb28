"""Variance that no estimator models: friction of joints at rest, lasting errors, and motion faster than in training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray

from lipcore.data.independence import INDEPENDENT_HZ, recording_weights
from lipcore.data.motion import Indices, Motion
from lipcore.data.repetition import measure_distinct_share
from lipcore.data.samples import Array, Samples
from lipcore.data.signals import noise_level
from lipcore.kernels.arrays import constant
from lipcore.kernels.drive.play import deflections_of
from lipcore.kernels.drive.terms import SIGN_WIDTH
from lipcore.kernels.fast.answer import ACCELERATED, MISFIT_ROWS


@dataclass(frozen=True)
class MisfitOptions:
    """Constants of lasting errors, and of the variance at low speed."""

    lasting_s: float = 1.0
    """Time over which an error that is not white noise stays the same, s. The motion stays the same for this time.
    Tuned on simulated arms with `Dirt` (seeds 50 and 51 of `benchmarks/studies/dirty_arms.py`) among 0.5, 0.67 and
    1."""
    rest_share: float = 0.5
    """Variance of the torque that keeps a joint at rest, relative to its squared Coulomb torque. This value is that of
    a joint that stopped anywhere on a slow oscillation. It would be 1/3 if all such torques were equally likely, and 1
    if only the largest one occurred."""
    stick_share: float = 0.1
    """Variance of the torque of play elements at rest, relative to its square: a joint that stands still holds up to
    half as much again as one that slips. Tuned on a simulated Panda with `Dirt` (seed 0), which had a coverage of 5 to
    98 % at standstill without it and 100 % with it; with 0.05 it was 84 to 100 %."""
    speeds: tuple[float, ...] = (0.01, 0.02, 0.05, 0.1, 0.2)
    """Speeds below which friction may be unknown, rad/s (m/s)."""
    min_gain_nats: float = 10.0
    """Min gain in evidence from additional variance at low speed."""
    white_ratio: float = 1.5
    """Ratio of the variance to its estimate from white noise that chance explains."""
    min_share: float = 0.01
    """Min variance of faster motion, as a share of the mean square."""


OPTIONS = MisfitOptions()
EARLIER_ROWS = 5
"""Rows of a packed misfit of earlier releases."""


@dataclass(frozen=True)
class Misfit:
    """Variance in addition to noise and posterior, of joints at N velocities dq (eq. 25 of docs/method.md).

        at rest      rest_j exp(−(dq_j / slow_j)²) + still_j exp(−(dq_j / w)²) + (Σ_k |f_jk| d_jk)²
        faster       lasting_j (max(0, mean_i (dq_i / speed_i)² − 1) + ACCELERATED max(0, mean_i (ddq_i / u_i)² − 1))

    u is `acceleration`, w is SIGN_WIDTH. The variance of faster motion depends on all joints i of the same arm. d is
    the standard deviation of an element's deflection, f its torque.
    """

    rest: Array
    """Variance of friction before breakaway or just after a reversal, (n,) (N·m)²."""
    slow: Array
    """Speed at which that variance has decayed to exp(−1), (n,) rad/s (m/s)."""
    lasting: Array
    """Part of the noise variance that lasts, (n,) (N·m)². Its error is the same in neighbouring rows. It grows with
    motion beyond that of the training, as its cause does."""
    speed: Array
    """Root mean square of dq in training, (n,)."""
    acceleration: Array
    """Root mean square of ddq in training, (n,)."""
    still: Array
    """Variance of friction of joints that stand still, beyond `rest`, (n,) (N·m)²."""
    elements: Array = field(default_factory=lambda: np.zeros((2, 0, 1)))
    """Torque |w| of the drive's play elements as trained, and their widths, (2, K, n)."""
    arms: Indices = field(default_factory=lambda: np.zeros(0, np.int64))
    """Index of each joint's arm, (n,); all zero if not given. It is not part of `packed`: the geometry has it."""

    def __post_init__(self) -> None:
        if not len(self.arms):
            object.__setattr__(self, "arms", np.zeros(len(self.rest), np.int64))

    @classmethod
    def none(cls, n: int) -> Misfit:
        """Return a misfit of zero, for n joints."""
        zero, one = np.zeros(n), np.ones(n)
        return cls(zero, one, zero, one, one, zero)

    @classmethod
    def unpacked(cls, values: Array) -> Misfit:
        """Return the misfit from the result of `packed`, or from the first five rows, of earlier releases."""
        if len(values) == EARLIER_ROWS:
            values = np.concatenate([values, np.zeros((1, values.shape[1]))])
        rest, slow, lasting, speed, acceleration, still = values[:MISFIT_ROWS]
        elements = values[MISFIT_ROWS:].reshape(2, (len(values) - MISFIT_ROWS) // 2, values.shape[1])
        return cls(rest, slow, lasting, speed, acceleration, still, elements)

    def packed(self) -> Array:
        """Return the fields as rows, (6 + 2 K, n)."""
        own = np.stack([self.rest, self.slow, self.lasting, self.speed, self.acceleration, self.still])
        return np.concatenate([own, self.elements.reshape(-1, own.shape[1])])

    def of_joints(self, joints: NDArray[np.int64]) -> Misfit:
        """Return this misfit with the joints in another order. joints: (n,), their places in this misfit."""
        return replace(Misfit.unpacked(self.packed()[:, joints]), arms=self.arms[joints])

    def with_friction(self, coulomb: Array) -> Misfit:
        """Return this misfit for joints that stand still, with at least `rest_share` × `coulomb`² there, (n,) N·m.

        coulomb: without the play elements, which are known except for `stick_share`. This also applies to joints that
        never moved.
        """
        least = OPTIONS.rest_share * coulomb**2 + OPTIONS.stick_share * self.elements[0].sum(axis=0) ** 2
        return replace(self, still=np.maximum(least - self.rest, 0.0))

    def with_rest(self, other: Misfit) -> Misfit:
        """Return this misfit, with the low speeds of another misfit for joints with a larger variance there."""
        larger = other.rest + other.still > self.rest + self.still
        low = {name: np.where(larger, getattr(other, name), getattr(self, name)) for name in ("rest", "slow", "still")}
        return replace(self, **low)

    @property
    def is_nonzero(self) -> bool:
        """Whether any variance is above zero."""
        parts = (self.rest, self.lasting, self.still, self.elements)
        return any((each > 0).any() for each in parts)

    def at_rest(self, motion: Motion) -> Array:
        """Return the variance of friction at low speed, or after unknown motion, (N, n) (N·m)²."""
        rest, slow, still = (constant(each, motion.dq) for each in (self.rest, self.slow, self.still))
        exp = array_namespace(motion.dq).exp
        out: Array = rest * exp(-((motion.dq / slow) ** 2)) + still * exp(-((motion.dq / SIGN_WIDTH) ** 2))
        if self.elements.size:
            torque, widths = self.elements
            known = deflections_of(motion, widths, self.acceleration)
            out = out + (constant(torque, motion.dq) * known[:, len(widths) :]).sum(1) ** 2
        return out

    def variance(self, motion: Motion) -> Array:
        """Return the variance of the torques at N instants, (N, n) (N·m)²."""
        usual, lasting = (self.speed, self.acceleration), constant(self.lasting, motion.dq)
        xp = array_namespace(motion.dq)
        speed, acceleration = (
            xp.clip(self._of_arms((each / constant(most, each)) ** 2) - 1, 0.0, None)
            for each, most in zip((motion.dq, motion.ddq), usual, strict=True)
        )
        total: Array = self.at_rest(motion) + lasting * (speed + ACCELERATED * acceleration)
        return total

    def _of_arms(self, squares: Array) -> Array:
        """Return the mean over the joints of each joint's arm, (N, n) or (N, 1). squares: (N, n)."""
        if not self.arms.any():
            mean: Array = squares.mean(-1)[:, None]
            return mean
        same = self.arms[:, None] == self.arms
        out: Array = (squares[:, None] * constant(same / same.sum(axis=1), squares)).sum(-1)
        return out

    def of_row(self, noise: Array, motion: Motion, rows: float = INDEPENDENT_HZ * OPTIONS.lasting_s) -> Array:
        """Return the variance R of each of N rows when it is learnt, (N, n) (N·m)².

        White noise is new in every row. A lasting error is common to `rows` rows, which count together as one. noise:
        (n,) (N·m)², white or lasting.
        """
        return noise + (rows - 1) * self.lasting + rows * self.at_rest(motion)


def shared_rows(samples: Samples, joint_types: Sequence[str], count: int) -> float:
    """Return how many of `count` rows, chosen from a whole recording, share one lasting error: at least 1.

    Such errors are functions of the motion, so repeated motion has the same errors. joint_types: (n,).
    """
    seconds = float(
        recording_weights(samples.t, samples.episode, 1 / OPTIONS.lasting_s).sum()
    ) * measure_distinct_share(samples, joint_types)
    return max(1.0, count / seconds) if seconds > 0 else 1.0


def estimate_misfit(
    residual: Array, tau: Array, motion: Array, episodes: Sequence[slice], least: Array | float = 0.0
) -> tuple[Misfit, Array]:
    """Return the misfit from residuals, and the variance of the noise in motion, (n,) (N·m)².

    residual: (N, n) N·m, of contiguous samples; tau: (N, n), their torques; motion: (2, N, n), their velocities and
    accelerations; episodes: their rows; least: (n,) (N·m)², min noise variance. The white noise is estimated from
    differences of neighbouring torques or residuals. Up to `white_ratio` times its variance counts as white; the rest
    lasts.
    """
    noise, rest, slow = low_speed_variance(residual, motion[0])
    noise = np.maximum(noise, least)
    # residuals may be rougher than torques if the model's friction reverses at once
    white = np.minimum(*(noise_level([each[part] for part in episodes]) for each in (residual, tau)))
    lasting = np.maximum(noise - OPTIONS.white_ratio * white**2, 0.0)
    usual = np.maximum(np.sqrt(np.mean(motion**2, axis=1)), SIGN_WIDTH)
    return Misfit(rest, slow, lasting, usual[0], usual[1], np.zeros_like(rest)), noise


def low_speed_variance(residual: Array, dq: Array) -> tuple[Array, Array, Array]:
    """Return the most likely s², r and w of residuals with variance s² + r exp(−(dq / w)²), (n,) each.

    residual, dq: (N, n); w is one of the speeds. Fisher scoring estimates both variances at once. r is zero if it gains
    less than `min_gain_nats`.
    """
    unit = np.maximum(np.mean(residual**2, axis=0), np.finfo(float).tiny)
    squares, mean = residual**2 / unit, np.ones_like(unit)
    least = np.full_like(unit, 0.5 * len(residual) - OPTIONS.min_gain_nats)
    best = mean, np.zeros_like(unit), np.full_like(unit, SIGN_WIDTH)
    for speed in OPTIONS.speeds:
        low = np.exp(-((dq / speed) ** 2))
        noise, rest = mean, np.zeros_like(mean)
        for _ in range(30):
            weight = (noise + rest * low) ** -2.0
            total, cross, square = weight.sum(0), (weight * low).sum(0), (weight * low**2).sum(0)
            right, lowly = (weight * squares).sum(0), (weight * low * squares).sum(0)
            determinant = total * square - cross**2
            known = determinant > 1e-12 * total * square
            rest = np.where(known, (total * lowly - cross * right) / np.where(known, determinant, 1.0), 0.0)
            rest = np.maximum(rest, 0.0)
            noise = np.maximum((right - cross * rest) / total, OPTIONS.min_share)
        variance = noise + rest * low
        value = 0.5 * (np.log(variance) + squares / variance).sum(axis=0)
        better = value < least
        least = np.where(better, value, least)
        candidate = noise, rest, np.full_like(unit, speed)
        best = tuple(np.where(better, new, old) for new, old in zip(candidate, best, strict=True))
    noise, rest, slow = best
    return noise * unit, rest * unit, slow
