"""Generate motions within limits: references, and Fourier series that start and end at rest.

Swevers et al. (1997): a period of a finite Fourier series can be repeated, and enough instants bound its values between
them. Let m > 2 K be the number of evenly spaced instants of a period. The maximum of a trigonometric polynomial of
degree K is at most 1 / cos(π K / m) times its largest magnitude there (Ehlich & Zeller, 1964).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.excitation.limits import Limits

Coefficients = tuple[Array, Array, Array]
"""Shift (n,), sine and cosine amplitudes (K, n)."""


@dataclass(frozen=True)
class Series:
    """One period of q(t) = offset + Σ_k sine_k / (kω) sin kωt − cosine_k / (kω) cos kωt with ω = 2π / seconds.

    offset: (n,); sine, cosine: (K, n), amplitudes of the velocity in rad/s (m/s). It is at rest at both ends if Σ
    sine_k = 0 and Σ k cosine_k = 0.
    """

    seconds: float
    offset: Array
    sine: Array
    cosine: Array

    @property
    def harmonics(self) -> int:
        """Number of harmonics K."""
        return len(self.sine)

    def at(self, t: Array) -> tuple[Array, Array, Array]:
        """Return position, velocity and acceleration at times t (N,): each (N, n)."""
        omega = frequencies(self.seconds, self.harmonics)
        sin, cos = np.sin(np.outer(t, omega)), np.cos(np.outer(t, omega))
        q = self.offset + sin @ (self.sine / omega[:, None]) - cos @ (self.cosine / omega[:, None])
        dq = cos @ self.sine + sin @ self.cosine
        ddq = -sin @ (self.sine * omega[:, None]) + cos @ (self.cosine * omega[:, None])
        return q, dq, ddq

    def scaled(self, middle: Array, factor: Array | float) -> Series:
        """Return the motion shrunk towards `middle`, (n,), by a factor for all or for each joint."""
        return replace(
            self,
            offset=middle + factor * (self.offset - middle),
            sine=factor * self.sine,
            cosine=factor * self.cosine,
        )

    def used(self, limits: Limits) -> Array:
        """Return an upper bound of the used share of the limits: (3, n) of position, speed, acceleration."""
        m = 64 * self.harmonics  # the bound then lies 0.12 % above the peaks
        q, dq, ddq = self.at(np.arange(m) / m * self.seconds)
        peaks = [np.abs(q - limits.middle).max(0), np.abs(dq).max(0), np.abs(ddq).max(0)]
        shares = np.array(peaks) / np.array([limits.half, limits.speed, limits.acceleration])
        return np.asarray(shares * overshoot(self.harmonics, m))


def frequencies(seconds: float, harmonics: int) -> Array:
    """Return kω for k = 1 … K, rad/s, with ω = 2π / seconds: (K,)."""
    return np.asarray(2 * np.pi / seconds * np.arange(1, harmonics + 1), dtype=np.float64)


def overshoot(harmonics: int, instants: int) -> float:
    """Return the max factor by which a trigonometric polynomial exceeds its values at evenly spaced instants.

    harmonics: its degree K; 1 / cos(π K / m) (Ehlich & Zeller, 1964).
    """
    return float(1 / np.cos(np.pi * harmonics / instants))


@dataclass(frozen=True)
class Shape:
    """Map of a matrix x (2 K + 1, n) to a motion of n joints within its limits, and of derivatives back.

    Row 0 shifts the middle, the next K are sine and the last K cosine amplitudes, each in units of what the limits
    allow to that harmonic alone. Two projections bring both ends to rest. Each joint is then shrunk towards its middle
    as far as the limits require: by (1 + g^p)^(1/p), g the p-norm of all shares of its limits.
    """

    limits: Limits
    seconds: float
    amplitude: Array
    """Velocity of each unit, (K, n)."""
    at_rest: Array
    """Unit directions that are projected out, (2, K, n)."""
    omega: Array

    @classmethod
    def build(cls, limits: Limits, seconds: float, harmonics: int) -> Shape:
        """Return the shape of a motion of `seconds` with K harmonics; raise ValueError for fewer than two harmonics."""
        if harmonics < 2:
            raise ValueError(f"harmonics is {harmonics}, expected at least 2 for a motion between two rests")
        omega = frequencies(seconds, harmonics)[:, None]
        reach = np.minimum.reduce([limits.half * omega, limits.speed + 0 * omega, limits.acceleration / omega])
        direction = np.stack([reach, reach * omega])
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return cls(limits, seconds, *(part for part in (reach, direction, omega[:, 0])))

    @property
    def size(self) -> tuple[int, int]:
        """Return the shape of x."""
        harmonics, n = self.amplitude.shape
        return 2 * harmonics + 1, n

    def coefficients(self, x: Array) -> Coefficients:
        """Return the shift from the middle, (n,), and the amplitudes (K, n), within the limits. x: (2 K + 1, n)."""
        shift, sine, cosine = self._free(x)
        shrink, _ = self._shrink(shift, sine, cosine)
        return shift / shrink, sine / shrink, cosine / shrink

    def motion(self, x: Array, t: Array) -> tuple[Array, Array, Array]:
        """Return position, velocity and acceleration at times t (N,), each (N, n)."""
        q, dq, ddq = self._motion(*self.coefficients(x), t)
        return self.limits.middle + q, dq, ddq

    def adjoint(self, x: Array, t: Array, q: Array, dq: Array, ddq: Array) -> Array:
        """Return the derivatives by x, (2 K + 1, n), given those by q, dq and ddq, each (N, n), at times t, (N,)."""
        free = self._free(x)
        shrink, by_shares = self._shrink(*free)
        slopes = self._motion_adjoint(t, q, dq, ddq)
        by_shrink = -sum(
            (slope * part).reshape(-1, len(shrink)).sum(0) for slope, part in zip(slopes, free, strict=True)
        )
        watched = by_shares * (by_shrink / shrink**2)
        more = self._motion_adjoint(self._watched, *watched)
        shift, sine, cosine = (slope / shrink + other for slope, other in zip(slopes, more, strict=True))
        out = np.empty_like(x)
        out[0] = shift * self.limits.half
        out[1:] = self._rested(np.stack([sine, cosine]) * self.amplitude).reshape(-1, len(shrink))
        return out

    def series(self, x: Array) -> Series:
        """Return the motion of x (2 K + 1, n) as a series, within the limits by their strict bound."""
        shift, sine, cosine = self.coefficients(x)
        series = Series(self.seconds, self.limits.middle + shift, sine, cosine)
        return series.scaled(self.limits.middle, 1 / np.maximum(1.0, series.used(self.limits).max(0)))

    def random(self, rng: np.random.Generator) -> Array:
        """Return a start for a search, (2 K + 1, n): harmonics of random strength and phase, faster ones weaker."""
        rows, n = self.size
        x = rng.standard_normal((rows, n))
        x[0] *= 0.3
        # some starts are mostly slow and far, others fast and short
        fall = rng.uniform(0.0, 1.0, n)
        harmonics = np.arange(1, len(self.omega) + 1)[:, None]
        x[1:] *= np.tile(harmonics**-fall, (2, 1))
        return np.asarray(x)

    def _free(self, x: Array) -> Coefficients:
        """Return the coefficients of x with both ends at rest, before the limits shrink them."""
        shift = x[0] * self.limits.half
        sine, cosine = self._rested(x[1:].reshape(2, *self.amplitude.shape)) * self.amplitude
        return shift, sine, cosine

    def _rested(self, waves: Array) -> Array:
        """Return waves (2, K, n) without their part along `at_rest`."""
        return np.asarray(waves - self.at_rest * (self.at_rest * waves).sum(1, keepdims=True))

    def _shrink(self, shift: Array, sine: Array, cosine: Array) -> tuple[Array, Array]:
        """Return each joint's divisor, (n,), and its derivatives by the motion at the instants, (3, m, n)."""
        limits, m = self.limits, len(self._watched)
        unit = np.stack([limits.half, limits.speed, limits.acceleration])[:, None] / overshoot(len(self.omega), m)
        motion = np.stack(self._motion(shift, sine, cosine, self._watched))
        shares = np.abs(motion) / unit
        # divide by the largest share first: powers overflow otherwise
        largest = shares.max((0, 1)).clip(1.0)
        p = 40  # a larger p is closer to the largest share, but its slope jumps
        powers = ((shares / largest) ** p).sum((0, 1)) + largest**-p
        shrink = largest * powers ** (1 / p)
        slopes = powers ** (1 / p - 1) * (shares / largest) ** (p - 1)
        return shrink, slopes * np.sign(motion) / unit

    @cached_property
    def _watched(self) -> Array:
        """Return the instants (m,) at which limits are checked."""
        m = 12 * len(self.omega)
        return np.arange(m) / m * self.seconds

    def _motion(self, shift: Array, sine: Array, cosine: Array, t: Array) -> tuple[Array, Array, Array]:
        omega, phase = self.omega[:, None], t[:, None] * self.omega
        sin, cos = np.sin(phase), np.cos(phase)
        q = shift + sin @ (sine / omega) - cos @ (cosine / omega)
        return q, cos @ sine + sin @ cosine, -sin @ (sine * omega) + cos @ (cosine * omega)

    def _motion_adjoint(self, t: Array, q: Array, dq: Array, ddq: Array) -> Coefficients:
        """Return the derivatives by shift, sine and cosine, given those by the results of `_motion`."""
        omega, phase = self.omega[:, None], t[:, None] * self.omega
        sin, cos = np.sin(phase).T, np.cos(phase).T
        sine = (sin @ q) / omega + cos @ dq - omega * (sin @ ddq)
        return q.sum(0), sine, -(cos @ q) / omega + sin @ dq + omega * (cos @ ddq)


def harmonics(limits: Limits, seconds: float) -> int:
    """Return the number of harmonics K of a motion of `seconds`.

    They reach the frequency at which the acceleration limit takes over from the speed limit.
    """
    fastest = float(np.max(limits.acceleration / limits.speed)) / (2 * np.pi)
    return int(np.clip(np.ceil(fastest * seconds), 5, 60))


def draw(limits: Limits, count: int, seed: int) -> Motion:
    """Return `count` instants of motion: one half from anywhere, the other half from random motions within the limits.

    Anywhere: positions evenly over the range, speeds and accelerations Gaussian, of a third of the limits and clipped
    there. Tasks seldom require so much: joints are rarely at the ends of their ranges and fast at the same time. Random
    motions, some slow and far, some fast and short, omit corners that a task may require. Plans for both halves did
    better on motions of neither half than plans for one.
    """
    rng = np.random.default_rng(seed)
    some = count - count // 2
    q = rng.uniform(limits.lower, limits.upper, (some, limits.n_joints))
    dq, ddq = (
        np.clip(1 / 3 * rng.standard_normal(q.shape), -1, 1) * limit for limit in (limits.speed, limits.acceleration)
    )
    seconds, parts = 50.0, [np.stack([q, dq, ddq])]
    shape = Shape.build(limits, seconds, harmonics(limits, seconds))
    while some < count:
        instants = rng.uniform(0, seconds, min(5, count - some))
        parts.append(np.stack(shape.series(shape.random(rng)).at(instants)))
        some += len(instants)
    return Motion.from_arrays(*np.concatenate(parts, axis=1))
