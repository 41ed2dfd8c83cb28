"""Finite Fourier series of joint positions that start and end at rest, and never leave their limits.

Swevers et al. (1997): a period of a finite Fourier series can be repeated, and what it does between two instants is
known from enough of them: the maximum of a trigonometric polynomial of degree K is at most 1 / cos(π K / m) times its
largest magnitude at m > 2 K even instants of a period (Ehlich & Zeller, 1964).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lipcore.excitation.limits import Limits
from lipcore.samples import Array

DENSE = 64
"""Instants for each harmonic that peaks are looked for at: the bound then lies 0.12 % above them."""


@dataclass(frozen=True)
class Series:
    """One period of q(t) = offset + Σ_k sine_k / (kω) sin kωt − cosine_k / (kω) cos kωt with ω = 2π / seconds.

    offset: (n,); sine, cosine: (K, n), amplitudes of the velocity in rad/s (m/s). At rest at both ends where
    Σ sine_k = 0 and Σ k cosine_k = 0.
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
        """Position, velocity and acceleration at times t (N,): each (N, n)."""
        omega = frequencies(self.seconds, self.harmonics)
        sin, cos = np.sin(np.outer(t, omega)), np.cos(np.outer(t, omega))
        q = self.offset + sin @ (self.sine / omega[:, None]) - cos @ (self.cosine / omega[:, None])
        dq = cos @ self.sine + sin @ self.cosine
        ddq = -sin @ (self.sine * omega[:, None]) + cos @ (self.cosine * omega[:, None])
        return q, dq, ddq

    def scaled(self, middle: Array, factor: Array | float) -> Series:
        """The motion shrunk towards `middle`, (n,), by a factor for all or for each joint."""
        return replace(
            self,
            offset=middle + factor * (self.offset - middle),
            sine=factor * self.sine,
            cosine=factor * self.cosine,
        )

    def used(self, limits: Limits) -> Array:
        """Upper bound on the share of the limits that is used at any time: (3, n) of position, speed, acceleration."""
        m = DENSE * self.harmonics
        q, dq, ddq = self.at(np.arange(m) / m * self.seconds)
        peaks = [np.abs(q - limits.middle).max(0), np.abs(dq).max(0), np.abs(ddq).max(0)]
        shares = np.array(peaks) / np.array([limits.half, limits.speed, limits.acceleration])
        return np.asarray(shares * overshoot(self.harmonics, m))


def frequencies(seconds: float, harmonics: int) -> Array:
    """kω for k = 1 … K, rad/s."""
    return np.asarray(2 * np.pi / seconds * np.arange(1, harmonics + 1), dtype=np.float64)


def overshoot(harmonics: int, instants: int) -> float:
    """Most that a trigonometric polynomial exceeds its largest magnitude at so many even instants, as a factor."""
    return float(1 / np.cos(np.pi * harmonics / instants))
