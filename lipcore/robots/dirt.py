"""Imperfections of real arms in simulated recordings: friction with memory, ripple, gain errors, noise and encoders.

Friction is LuGre's (Canudas de Wit et al. 1995, doi 10.1109/9.376053): bristles of deflection z between two surfaces,

    dz/dt = v − σ₀ |v| z / g(v),    g(v) = F_c + (F_s − F_c) exp(−(v / v_s)²),    F = σ₀ z + σ₂ v.

A joint at rest resists any torque up to F_s and breaks away after a small displacement (presliding). Friction after a
reversal depends on the path (hysteresis). F_c and F_s grow with load, vary with position, and fall as the joint warms
up.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from lipcore.data.samples import Array
from lipcore.data.signals import differentiate, low_pass

MIN_SIMULATION_HZ = 1000.0
"""Min rate at which friction and noise are simulated, for any rate of the recording."""
JOINT_SPREAD = 0.5
"""Each joint has the amounts of `Dirt` times a random number from 1 − JOINT_SPREAD to 1 + JOINT_SPREAD."""
SCALED_AMOUNTS = ("friction", "stiction", "viscous", "load", "position", "warmth", "ripple", "gain", "noise", "encoder")
"""Amounts that `Dirt.scaled` multiplies."""


@dataclass(frozen=True)
class Dirt:
    """Amounts of the imperfections. The defaults describe an industrial arm that measures torque by its motor currents.

    Torques are in units of the joint's usual torque.
    """

    friction: float = 0.3
    """Coulomb torque."""
    stiction: float = 0.4
    """Extra torque to break away, as a share of Coulomb torque."""
    viscous: float = 0.2
    """Torque at 1 rad/s (1 m/s)."""
    load: float = 0.2
    """Relative growth of friction at the usual torque."""
    position: float = 0.1
    """Relative variation of friction over a turn."""
    warmth: float = 0.15
    """Relative excess of friction at the start."""
    ripple: float = 0.01
    """Amplitude of torque that repeats `cycles` times a radian."""
    gain: float = 0.02
    """Standard deviation of the error of the torque's factor."""
    noise: float = 0.02
    """Standard deviation of the noise, low-passed at `noise_hz`."""
    encoder: float = 1e-5
    """Position per count, rad (m)."""
    breakaway: float = 0.003
    """Displacement until a joint slides, rad (m)."""
    slow: float = 0.05
    """Stribeck speed, rad/s (m/s)."""
    warm_s: float = 300.0
    """Time constant of warming up."""
    cycles: float = 100.0
    """Cycles of the ripple per radian (m)."""
    noise_hz: float = 20.0
    motion_hz: float = 10.0
    """Cut-off of the low-pass without delay. Velocities and accelerations are differences of low-passed counts."""
    seed: int = 0
    """Seed of the differences between joints, which all recordings of an arm share."""

    def __post_init__(self) -> None:
        for each in fields(self):
            value, positive = getattr(self, each.name), each.name not in (*SCALED_AMOUNTS, "seed")
            if not (0 < value < np.inf or (value == 0 and not positive)):
                kind = "a positive number" if positive else "a number of at least 0"
                raise ValueError(f"{each.name} of the dirt is {value}, expected {kind}")

    def scaled(self, level: float) -> Dirt:
        """Return these amounts multiplied by `level`: 0 is a perfect arm, 1 is this arm."""
        return replace(self, **{name: level * getattr(self, name) for name in SCALED_AMOUNTS})

    def torque(self, t: Array, q: Array, dq: Array, tau: Array, usual: Array, rng: np.random.Generator) -> Array:
        """Return the measured torque of an arm, (N, n) N·m (N).

        t: (N,) s, evenly spaced at MIN_SIMULATION_HZ or more; q, dq, tau: (N, n), motion and rigid-body torque; usual:
        (n,) N·m (N), the unit of the amounts; rng: of the noise.
        """
        n, arm = len(usual), np.random.default_rng(self.seed)

        def drawn(share: float) -> Array:
            return share * arm.uniform(1 - JOINT_SPREAD, 1 + JOINT_SPREAD, n)

        grows = 1 + drawn(self.load) * np.abs(tau) / usual
        grows = grows * (1 + drawn(self.position) * np.sin(q + arm.uniform(0, 2 * np.pi, n)))
        grows = grows * (1 + drawn(self.warmth) * np.exp(-t[:, None] / self.warm_s))
        coulomb = usual * drawn(self.friction) * grows
        breaks = coulomb * (1 + drawn(self.stiction))
        out = tau + simulate_lugre(t, dq, coulomb, breaks, self.breakaway, self.slow) + usual * drawn(self.viscous) * dq
        out = out + usual * drawn(self.ripple) * np.sin(self.cycles * q + arm.uniform(0, 2 * np.pi, n))
        out = out * (1 + self.gain * arm.standard_normal(n))
        return np.asarray(out + usual * self.noise * draw_coloured_noise(rng, tau.shape, t[1] - t[0], self.noise_hz))

    def motion(self, t: Array, q: Array) -> tuple[Array, Array, Array]:
        """Return the position as the encoder reports it, and velocity and acceleration derived from it, (N, n)."""
        rate = 1.0 / (t[1] - t[0])
        counted = q if self.encoder == 0 else self.encoder * np.round(q / self.encoder)
        smooth = low_pass(counted, rate, self.motion_hz)
        dq = differentiate(smooth, rate)
        return counted, dq, differentiate(dq, rate)


def simulate_lugre(t: Array, dq: Array, coulomb: Array, breaks: Array, breakaway: float, slow: float) -> Array:
    """Return LuGre friction without its viscous part, (N, n) N·m, of joints that begin at rest with slack bristles.

    t: (N,) s; dq: (N, n); coulomb, breaks: (N, n) F_c and F_s; breakaway: deflection at F_s, so σ₀ = F_s / breakaway.
    Exact for velocities that are constant between samples.
    """
    stiffness = breaks / breakaway
    g = coulomb + (breaks - coulomb) * np.exp(-((dq / slow) ** 2))
    steps = np.diff(t, prepend=t[0])[:, None]
    rate = np.divide(stiffness * np.abs(dq), g, out=np.zeros_like(g), where=g > 0)
    kept = np.exp(-rate * steps)
    # ∫ exp(−rate s) ds over a step: the step itself if nothing slides
    slid = np.divide(1 - kept, rate, out=np.broadcast_to(steps, rate.shape).copy(), where=rate * steps > 1e-9)
    pushed, z = dq * slid, np.zeros(dq.shape[1])
    out = np.empty_like(dq)
    for k in range(len(t)):
        z = kept[k] * z + pushed[k]
        out[k] = stiffness[k] * z
    return out


def draw_coloured_noise(rng: np.random.Generator, shape: tuple[int, ...], step: float, cutoff: float) -> Array:
    """Return noise of standard deviation 1 after a first-order low-pass at `cutoff` Hz, every `step` s: (N, n)."""
    from scipy.signal import lfilter  # noqa: PLC0415 - half a second, for imperfect arms only

    kept = np.exp(-2 * np.pi * cutoff * step)
    white = rng.standard_normal(shape)
    white[1:] *= np.sqrt(1 - kept**2)  # the first row has the stationary distribution
    return np.asarray(lfilter([1.0], [1.0, -kept], white, axis=0))
