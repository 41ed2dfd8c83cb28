"""What real recordings hold besides rigid bodies: friction with memory, ripple, gain errors, coloured noise, encoders.

Friction is LuGre's (Canudas de Wit et al. 1995, doi 10.1109/9.376053): bristles of deflection z between two surfaces,

    dz/dt = v − σ₀ |v| z / g(v),    g(v) = F_c + (F_s − F_c) exp(−(v / v_s)²),    F = σ₀ z + σ₂ v,

so that a joint at rest holds any torque up to F_s, breaks away after a small displacement (presliding), and friction
after a reversal depends on the way there (hysteresis). F_c and F_s grow with load, vary with position, and fall as the
joint warms up.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from lipcore.data.samples import Array
from lipcore.data.signals import differentiate, low_pass

FINE_HZ = 1000.0
"""Friction and noise are simulated at this rate at least, whatever the rate of the recording."""
SPREAD = 0.5
"""Joints differ: each has its amounts times a number from 1 − SPREAD to 1 + SPREAD."""
RELATIVE = ("friction", "stiction", "viscous", "load", "position", "warmth", "ripple", "gain", "noise", "encoder")
"""Amounts that `times` multiplies."""


@dataclass(frozen=True)
class Dirt:
    """How dirty. Defaults are an industrial arm's, whose torque is measured by its currents.

    Torques are in units of the joint's usual torque. friction: Coulomb torque;
    stiction: what breaking away takes more, share of it; viscous: torque at 1 rad/s; load, position: by how much
    friction grows with the usual torque, and varies over a turn; warmth: by how much it is higher at the start, which
    fades over warm_s; breakaway: rad (m) until a joint slides; slow: Stribeck speed, rad/s (m/s); ripple: torque that
    repeats `cycles` times a radian; gain: error of the torque's factor; noise: its standard deviation, low-passed at
    noise_hz; encoder: rad (m) a count; velocities and accelerations are differences of counts, low-passed at
    motion_hz without delay. seed: of how the joints differ, which is the arm's and the same in all of its streams.
    """

    friction: float = 0.3
    stiction: float = 0.4
    viscous: float = 0.2
    load: float = 0.2
    position: float = 0.1
    warmth: float = 0.15
    ripple: float = 0.01
    gain: float = 0.02
    noise: float = 0.02
    encoder: float = 1e-5
    breakaway: float = 0.003
    slow: float = 0.05
    warm_s: float = 300.0
    cycles: float = 100.0
    noise_hz: float = 20.0
    motion_hz: float = 10.0
    seed: int = 0

    def __post_init__(self) -> None:
        for each in fields(self):
            value, positive = getattr(self, each.name), each.name not in (*RELATIVE, "seed")
            if not (0 < value < np.inf or (value == 0 and not positive)):
                kind = "a positive number" if positive else "a number of at least 0"
                raise ValueError(f"{each.name} of the dirt is {value}, expected {kind}")

    def times(self, level: float) -> Dirt:
        """So many times as dirty: 0 is clean, 1 as it is."""
        return replace(self, **{name: level * getattr(self, name) for name in RELATIVE})

    def torque(self, t: Array, q: Array, dq: Array, tau: Array, usual: Array, rng: np.random.Generator) -> Array:
        """The measured torque of an arm that moves so, (N, n) N·m.

        t: (N,) s, evenly spaced at FINE_HZ or more; q, dq, tau: (N, n), motion and rigid-body torque; usual: (n,) N·m,
        in units of which the amounts are; rng: of the noise.
        """
        n, arm = len(usual), np.random.default_rng(self.seed)

        def drawn(share: float) -> Array:
            return share * arm.uniform(1 - SPREAD, 1 + SPREAD, n)

        grows = 1 + drawn(self.load) * np.abs(tau) / usual
        grows = grows * (1 + drawn(self.position) * np.sin(q + arm.uniform(0, 2 * np.pi, n)))
        grows = grows * (1 + drawn(self.warmth) * np.exp(-t[:, None] / self.warm_s))
        coulomb = usual * drawn(self.friction) * grows
        breaks = coulomb * (1 + drawn(self.stiction))
        out = tau + lugre(t, dq, coulomb, breaks, self.breakaway, self.slow) + usual * drawn(self.viscous) * dq
        out = out + usual * drawn(self.ripple) * np.sin(self.cycles * q + arm.uniform(0, 2 * np.pi, n))
        out = out * (1 + self.gain * arm.standard_normal(n))
        return np.asarray(out + usual * self.noise * coloured(rng, tau.shape, t[1] - t[0], self.noise_hz))

    def motion(self, t: Array, q: Array) -> tuple[Array, Array, Array]:
        """Position, velocity and acceleration as counted and derived from counts: (N, n) each. q: (N, n)."""
        rate = 1.0 / (t[1] - t[0])
        counted = q if self.encoder == 0 else self.encoder * np.round(q / self.encoder)
        smooth = low_pass(counted, rate, self.motion_hz)
        dq = differentiate(smooth, rate)
        return counted, dq, differentiate(dq, rate)


def lugre(t: Array, dq: Array, coulomb: Array, breaks: Array, breakaway: float, slow: float) -> Array:
    """LuGre's friction without its viscous part, (N, n) N·m, of joints that begin at rest with slack bristles.

    t: (N,) s; dq: (N, n); coulomb, breaks: (N, n) F_c and F_s; breakaway: deflection at F_s, so σ₀ = F_s / breakaway.
    Exact for velocities that are constant between samples.
    """
    stiffness = breaks / breakaway
    g = coulomb + (breaks - coulomb) * np.exp(-((dq / slow) ** 2))
    steps = np.diff(t, prepend=t[0])[:, None]
    rate = np.divide(stiffness * np.abs(dq), g, out=np.zeros_like(g), where=g > 0)
    kept = np.exp(-rate * steps)
    # ∫ exp(−rate s) ds over a step: the step itself where nothing slides
    slid = np.divide(1 - kept, rate, out=np.broadcast_to(steps, rate.shape).copy(), where=rate * steps > 1e-9)
    pushed, z = dq * slid, np.zeros(dq.shape[1])
    out = np.empty_like(dq)
    for k in range(len(t)):
        z = kept[k] * z + pushed[k]
        out[k] = stiffness[k] * z
    return out


def coloured(rng: np.random.Generator, shape: tuple[int, ...], step: float, cutoff: float) -> Array:
    """Noise of standard deviation 1 behind a first-order low-pass at `cutoff` Hz, sampled every `step` s: (N, n)."""
    from scipy.signal import lfilter  # noqa: PLC0415 - half a second, for dirty streams only

    kept = np.exp(-2 * np.pi * cutoff * step)
    white = rng.standard_normal(shape)
    white[1:] *= np.sqrt(1 - kept**2)  # the first is drawn from what the others tend to
    return np.asarray(lfilter([1.0], [1.0, -kept], white, axis=0))
