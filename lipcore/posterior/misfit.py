"""What no estimator expresses, as variance: friction of joints at rest, errors that last, motion faster than seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lipcore.data.independence import INDEPENDENT_HZ, recording_weights
from lipcore.data.motion import Motion
from lipcore.data.repetition import distinct
from lipcore.data.samples import Array, Samples
from lipcore.data.signals import noise_level
from lipcore.kernels.fast.answer import ACCELERATED
from lipcore.kernels.friction import SIGN_WIDTH


@dataclass(frozen=True)
class MisfitOptions:
    """What lasts of errors, and what variance at low speed must gain."""

    lasting_s: float = 1.0
    """Time over which an error that is no white noise is the same, s: as long as the motion is. Tuned on simulated arms
    with `Dirt` (seeds 50 and 51 of `benchmarks/studies/dirty_arms.py`) among 0.5, 0.67 and 1."""
    rest_share: float = 0.5
    """Variance of the torque that holds a joint at rest, in units of its Coulomb torque squared: that of a joint which
    stopped anywhere on a slow oscillation; 1/3 if all holding torques were equally likely, 1 if only the largest."""
    speeds: tuple[float, ...] = (0.01, 0.02, 0.05, 0.1, 0.2)
    """Speeds below which friction may be unknown, rad/s (m/s)."""
    min_gain_nats: float = 10.0
    """Min gain of more variance at low speed."""
    white_ratio: float = 1.5
    """Variance over the estimated one of white noise that chance explains."""
    min_share: float = 0.01
    """Min variance of faster motion, as a share of the mean square."""


OPTIONS = MisfitOptions()


@dataclass(frozen=True)
class Misfit:
    """Variance besides noise and posterior, of joints at N velocities dq (eq. 25 of docs/method.md).

        at rest      rest_j exp(−(dq_j / slow_j)²)
        faster       lasting_j (max(0, mean_i (dq_i / speed_i)² − 1) + ACCELERATED max(0, mean_i (ddq_i / u_i)² − 1))

    rest: (n,) (N·m)², of friction that has not broken away or has just turned round; slow: (n,) rad/s (m/s); lasting:
    (n,) (N·m)², share of the noise's variance that lasts: the error of neighbouring rows is the same, and grows with
    motion beyond what was seen, as what causes it does; speed, acceleration u: (n,) root mean squares of dq and ddq in
    training.
    """

    rest: Array
    slow: Array
    lasting: Array
    speed: Array
    acceleration: Array

    @classmethod
    def none(cls, n: int) -> Misfit:
        """No such variance, for n joints."""
        zero, one = np.zeros(n), np.ones(n)
        return cls(zero, one, zero, one, one)

    @classmethod
    def unpacked(cls, values: Array) -> Misfit:
        """From what `packed` returns, (5, n)."""
        return cls(*values)

    def packed(self) -> Array:
        """Its fields one below the other, (5, n)."""
        return np.stack([self.rest, self.slow, self.lasting, self.speed, self.acceleration])

    def of_joints(self, joints: NDArray[np.int64]) -> Misfit:
        """The same with the joints in another order. joints: (n,), their places in this one."""
        return Misfit.unpacked(self.packed()[:, joints])

    def with_friction(self, coulomb: Array) -> Misfit:
        """The same with at least `rest_share` of the squared Coulomb torques at rest, (n,) N·m, moved so far or not."""
        return replace(self, rest=np.maximum(self.rest, OPTIONS.rest_share * coulomb**2))

    def with_rest(self, other: Misfit) -> Misfit:
        """The same with the variance at rest, and its speed, of another where that is larger."""
        larger = other.rest > self.rest
        rest, slow = np.where(larger, other.rest, self.rest), np.where(larger, other.slow, self.slow)
        return replace(self, rest=rest, slow=slow)

    @property
    def exists(self) -> bool:
        """Whether there is any."""
        return bool((self.rest > 0).any() or (self.lasting > 0).any())

    def at_rest(self, dq: Array) -> Array:
        """Variance of friction at low speed, (N, n) (N·m)². dq: (N, n)."""
        return np.asarray(self.rest * np.exp(-((dq / self.slow) ** 2)))

    def variance(self, motion: Motion) -> Array:
        """Variance of the torques at N instants, (N, n) (N·m)²."""
        speed = ((motion.dq / self.speed) ** 2).mean(axis=-1, keepdims=True) - 1
        acceleration = ((motion.ddq / self.acceleration) ** 2).mean(axis=-1, keepdims=True) - 1
        faster = speed.clip(0.0) + ACCELERATED * acceleration.clip(0.0)
        return np.asarray(self.at_rest(motion.dq) + self.lasting * faster)

    def of_row(self, noise: Array, dq: Array, rows: float = INDEPENDENT_HZ * OPTIONS.lasting_s) -> Array:
        """Variance R with which each of N rows teaches, (N, n) (N·m)²: white noise is new in every row, an error that
        lasts is that of `rows` rows, which count together as one.

        noise: (n,) (N·m)², white or lasting.
        """
        return noise + (rows - 1) * self.lasting + rows * self.at_rest(dq)


def shared_rows(samples: Samples, joint_types: Sequence[str], count: int) -> float:
    """Of `count` rows chosen from all over a recording, how many have an error in common where it lasts: at least 1.

    Such errors are functions of motion, so motion that repeats itself has the same again. joint_types: (n,).
    """
    seconds = float(recording_weights(samples.t, samples.episode, 1 / OPTIONS.lasting_s).sum()) * distinct(
        samples, joint_types
    )
    return max(1.0, count / seconds) if seconds > 0 else 1.0


def estimate(
    residual: Array, tau: Array, motion: Array, episodes: Sequence[slice], least: Array | float = 0.0
) -> tuple[Misfit, Array]:
    """The misfit that residuals prove, and the variance of the noise in motion, (n,) (N·m)².

    residual: (N, n) N·m, what a model leaves of contiguous samples; tau: (N, n), their torques; motion: (2, N, n),
    their velocities and accelerations; episodes: their rows; least: (n,) (N·m)², that the noise has at least. What
    differences of neighbours say, of torques or of residuals, is white noise, and `white_ratio` times that; the rest
    lasts.
    """
    noise, rest, slow = low_speed_variance(residual, motion[0])
    noise = np.maximum(noise, least)
    # residuals may be rougher than torques, where the model's friction turns round at once
    white = np.minimum(*(noise_level([each[part] for part in episodes]) for each in (residual, tau)))
    lasting = np.maximum(noise - OPTIONS.white_ratio * white**2, 0.0)
    usual = np.maximum(np.sqrt(np.mean(motion**2, axis=1)), SIGN_WIDTH)
    return Misfit(rest, slow, lasting, *usual), noise


def low_speed_variance(residual: Array, dq: Array) -> tuple[Array, Array, Array]:
    """Most likely s², r and w of residuals of variance s² + r exp(−(dq / w)²): (n,) each, w one of the speeds.

    residual, dq: (N, n). Fisher scoring of both variances at once; r is zero where it gains less than `min_gain_nats`.
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
