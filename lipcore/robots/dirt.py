"""Imperfections of real arms in simulated recordings: friction with memory, ripple, gain errors, noise and encoders.

Three drives differ in their friction. It grows with the load, varies with position, and falls as the joint warms up.

`lugre` (Canudas de Wit et al. 1995, doi 10.1109/9.376053): bristles of deflection z between two surfaces,

    dz/dt = v − σ₀ |v| z / g(v),    g(v) = F_c + (F_s − F_c) exp(−(v / v_s)²),    F = σ₀ z + σ₂ v.

A joint at rest resists any torque up to F_s and breaks away after a small displacement (presliding). Friction after a
reversal depends on the path (hysteresis).

`maxwell`, generalised Maxwell slip (Al-Bender et al. 2005, doi 10.1109/TAC.2005.858676): Coulomb friction, and elements
of width r_k that deflect by e_k, from slack on,

    e_k ← clip(e_k + Δq / r_k, −1, 1),    F = (F_c + λ |τ|) tanh(v / w) + Σ_k f_k e_k + σ₂ v.

The share of the load λ belongs to the Coulomb friction alone. `Dirt.coefficients` returns F_c, λ, f and σ₂.

`elastic`: `lugre` behind a spring of stiffness k. The sensors are at the motor, at θ = q + τ / k. Friction acts there.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Literal, get_args

import numpy as np

from lipcore.data.samples import Array
from lipcore.data.signals import differentiate, low_pass

DriveModel = Literal["lugre", "maxwell", "elastic"]

MIN_SIMULATION_HZ = 1000.0
"""Min rate at which friction and noise are simulated, for any rate of the recording."""
JOINT_SPREAD = 0.5
"""Each joint has the amounts of `Dirt` times a random number from 1 − JOINT_SPREAD to 1 + JOINT_SPREAD."""
SCALED_AMOUNTS = (
    *("friction", "stiction", "viscous", "load", "position", "warmth", "viscous_warmth", "ripple", "gain", "noise"),
    *("encoder", "spring"),
)
"""Amounts that `Dirt.scaled` multiplies."""
MAXWELL_ELEMENTS = ((0.003, 0.3), (0.03, 0.3))
"""Elements of the `maxwell` drive: width, rad (m), and share of the friction."""


@dataclass(frozen=True)
class MaxwellCoefficients:
    """Friction of n joints with the `maxwell` drive."""

    viscous: Array
    """σ₂, (n,) N·m·s/rad (N·s/m)."""
    coulomb: Array
    """F_c, (n,) N·m (N)."""
    load: Array
    """λ, friction per torque that the bodies need, (n,)."""
    elements: Array
    """f, torque of each element when it slips, (K, n) N·m (N)."""


@dataclass(frozen=True)
class _JointAmounts:
    """Amounts of `Dirt` of each joint, (n,), and phases, rad."""

    load: Array
    position: Array
    position_phase: Array
    warmth: Array
    friction: Array
    stiction: Array
    viscous: Array
    ripple: Array
    ripple_phase: Array
    gain: Array
    """Factor on the torque."""
    viscous_warmth: Array
    spring: Array


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
    viscous_warmth: float = 0.0
    """Relative excess of the viscous torque at the start: 0.5 if it falls by a third."""
    ripple: float = 0.01
    """Amplitude of torque that repeats `cycles` times a radian."""
    gain: float = 0.02
    """Standard deviation of the error of the torque's factor."""
    noise: float = 0.02
    """Standard deviation of the noise, low-passed at `noise_hz`."""
    encoder: float = 1e-5
    """Position per count, rad (m)."""
    spring: float = 0.003
    """Deflection of the `elastic` drive at the usual torque, rad (m)."""
    breakaway: float = 0.003
    """Displacement until a joint slides, rad (m)."""
    slow: float = 0.05
    """Stribeck speed, rad/s (m/s)."""
    sign: float = 0.02
    """Speed w over which the Coulomb friction of the `maxwell` drive turns, rad/s (m/s)."""
    warm_s: float = 300.0
    """Time constant of warming up."""
    cycles: float = 100.0
    """Cycles of the ripple per radian (m)."""
    noise_hz: float = 20.0
    motion_hz: float = 10.0
    """Cut-off of the low-pass without delay. Velocities and accelerations are differences of low-passed counts."""
    seed: int = 0
    """Seed of the differences between joints, which all recordings of an arm share."""
    drive: DriveModel = "lugre"

    def __post_init__(self) -> None:
        if self.drive not in get_args(DriveModel):
            raise ValueError(f"drive is {self.drive!r}, expected one of {', '.join(get_args(DriveModel))}")
        for each in (one for one in fields(self) if one.name != "drive"):
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
        joints = self._draw_joints(len(usual))
        grows = 1 + joints.load * np.abs(tau) / usual if self.drive != "maxwell" else np.ones_like(tau)
        grows = grows * (1 + joints.position * np.sin(q + joints.position_phase))
        warm = np.exp(-t[:, None] / self.warm_s)
        grows = grows * (1 + joints.warmth * warm)
        if self.drive == "maxwell":
            friction = grows * self._maxwell(q, dq, tau, usual)
        else:
            coulomb = usual * joints.friction * grows
            breaks = coulomb * (1 + joints.stiction)
            friction = simulate_lugre(t, dq, coulomb, breaks, self.breakaway, self.slow)
        viscous = usual * joints.viscous * dq
        if self.viscous_warmth:
            viscous = viscous * (1 + joints.viscous_warmth * warm)
        out = tau + friction + viscous
        out = out + usual * joints.ripple * np.sin(self.cycles * q + joints.ripple_phase)
        out = out * joints.gain
        return np.asarray(out + usual * self.noise * draw_coloured_noise(rng, tau.shape, t[1] - t[0], self.noise_hz))

    def coefficients(self, usual: Array) -> MaxwellCoefficients:
        """Return the friction of joints with the `maxwell` drive, for the usual torque of each, (n,) N·m (N).

        The measured torque has it exactly if `position`, `warmth`, `viscous_warmth`, `ripple` and `gain` are zero.
        """
        joints = self._draw_joints(len(usual))
        shares = np.array([share for _, share in MAXWELL_ELEMENTS])
        torque = usual * joints.friction
        return MaxwellCoefficients(
            usual * joints.viscous,
            (1 - shares.sum()) * torque,
            joints.friction * joints.load,
            shares[:, None] * torque,
        )

    def motor_side(self, t: Array, q: Array, dq: Array, tau: Array, usual: Array) -> tuple[Array, Array]:
        """Return position and velocity of the motors, (N, n): those of the joints unless the drive is elastic."""
        if self.drive != "elastic":
            return q, dq
        motor = q + self._draw_joints(len(usual)).spring * tau / usual
        return motor, differentiate(motor, 1.0 / (t[1] - t[0]))

    def _maxwell(self, q: Array, dq: Array, tau: Array, usual: Array) -> Array:
        """Return the friction of the `maxwell` drive without its viscous part, (N, n) N·m (N)."""
        known = self.coefficients(usual)
        out = (known.coulomb + known.load * np.abs(tau)) * np.tanh(dq / self.sign)
        for (width, _), torque in zip(MAXWELL_ELEMENTS, known.elements, strict=True):
            out += torque * simulate_play(q, width)
        return np.asarray(out)

    def _draw_joints(self, n: int) -> _JointAmounts:
        """Return the amounts of n joints. Their order never changes: recordings of a seed stay the same."""
        arm = np.random.default_rng(self.seed)

        def drawn(share: float) -> Array:
            return share * arm.uniform(1 - JOINT_SPREAD, 1 + JOINT_SPREAD, n)

        return _JointAmounts(
            load=drawn(self.load),
            position=drawn(self.position),
            position_phase=arm.uniform(0, 2 * np.pi, n),
            warmth=drawn(self.warmth),
            friction=drawn(self.friction),
            stiction=drawn(self.stiction),
            viscous=drawn(self.viscous),
            ripple=drawn(self.ripple),
            ripple_phase=arm.uniform(0, 2 * np.pi, n),
            gain=1 + self.gain * arm.standard_normal(n),
            viscous_warmth=drawn(self.viscous_warmth),
            spring=drawn(self.spring),
        )

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


def simulate_play(q: Array, width: float) -> Array:
    """Return the deflection of an element of a `width`, rad (m), in units of it, (N, n): slack at first.

    q: (N, n).
    """
    out, anchor = np.empty_like(q), q[0]
    for k in range(len(q)):
        anchor = np.clip(anchor, q[k] - width, q[k] + width)
        out[k] = (q[k] - anchor) / width
    return out


def draw_coloured_noise(rng: np.random.Generator, shape: tuple[int, ...], step: float, cutoff: float) -> Array:
    """Return noise of standard deviation 1 after a first-order low-pass at `cutoff` Hz, every `step` s: (N, n)."""
    from scipy.signal import lfilter  # noqa: PLC0415 - half a second, for imperfect arms only

    kept = np.exp(-2 * np.pi * cutoff * step)
    white = rng.standard_normal(shape)
    white[1:] *= np.sqrt(1 - kept**2)  # the first row has the stationary distribution
    return np.asarray(lfilter([1.0], [1.0, -kept], white, axis=0))
