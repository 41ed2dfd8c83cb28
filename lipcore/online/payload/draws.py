"""Define the energy of arms that the training of a version allows, its minima, and draws from the posterior.

A draw is the minimum of the energy for other noise (randomised maximum likelihood, Kitanidis 1995, Oliver et al. 1996).
Draws from the training alone are made once; rows with a payload move them (`payload`).
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, cast
from weakref import WeakKeyDictionary

import numpy as np

from lipcore.arm.right_angles import DIRECTIONS, apply_layout
from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.geometry import Geometry
from lipcore.model.payload import Carrier, LinearisedCarrier, PayloadPosterior
from lipcore.online.payload.bodies import ANY_PAYLOAD, ETA_STD
from lipcore.online.payload.estimate import Instants, rows_of
from lipcore.robots.urdf import PARAMETERS


@dataclass(frozen=True)
class DrawOptions:
    """Steps of a descent, and draws from the posterior, which show how far it is from linear."""

    min_gain_nats: float = 0.01
    """Min gain of a step that is followed by another one."""
    damping: float = 1e-3
    """Damping of the first step, as a share of the curvature."""
    less: float = 0.15
    more: float = 8.0
    """Factors on the damping after a step that gains, and after one that does not."""
    min_damping: float = 1e-9
    max_damping: float = 1e8
    """Max damping: beyond it no step gains anything."""
    max_step: float = 0.5
    """Max step of the geometry, rad or m."""
    count: int = 10
    """Draws, continued from estimate to estimate."""
    wide: tuple[float, float] = (1.0, 6.0)
    """Range of the deviations of the linear posterior at which draws start: a bent posterior is wider."""
    steps: int = 20
    """Max steps in which draws become arms that the training allows."""
    seed: int = 0


DRAWS = DrawOptions()


@dataclass(frozen=True, eq=False)
class ArmWithPayload:
    """An arm and its payload. w: (M,); geometry: of the arm; eta: (10,)."""

    w: Array
    geometry: Geometry
    eta: Array

    def moved(self, carrier: Carrier, step: Array) -> ArmWithPayload:
        """Return the arm a whitened step away, (M + 10,), or at the max step in its direction."""
        size, steps = len(self.w), carrier.steps
        by, eta = carrier.memory.root @ step[:size], step[size:]
        longest = max(np.abs(eta / ETA_STD).max() / 2, np.abs(carrier.root[steps] * by[steps]).max() / DRAWS.max_step)
        return self.shifted(carrier, by / max(1.0, longest), eta / max(1.0, longest))

    def shifted(self, carrier: Carrier, by: Array, eta: Array) -> ArmWithPayload:
        """Return the arm with w larger by (M,), its geometry moved accordingly, and η larger by (10,)."""
        steps, learnt = carrier.steps, carrier.term.arm.geometry
        w, geometry = self.w + by, self.geometry.moved(carrier.root[steps] * by[steps])
        # large steps do not add up
        w[steps] = self.w[steps] + (learnt.towards(geometry) - learnt.towards(self.geometry)) / carrier.root[steps]
        return ArmWithPayload(w, geometry, self.eta + eta)

    def with_axis(self, joint: int, direction: int) -> ArmWithPayload:
        """Return the arm with an axis in one of six directions. joint: from base to tip; direction: any number."""
        layout = tuple(direction % len(DIRECTIONS) if each == joint else None for each in range(self.geometry.n_joints))
        return replace(self, geometry=apply_layout(self.geometry, layout))


@dataclass(frozen=True, eq=False)
class Draw:
    """A draw from the posterior: the minimum of the energy with residuals that are shifted by noise.

    noise: of the training and of the payload's prior; None: the minimum without noise.
    """

    place: ArmWithPayload
    noise: Array | None

    def is_usable(self, size: int) -> bool:
        """Return whether its noise has this size. Draws of one revision have noise of equal size."""
        return self.noise is None or len(self.noise) == size


@dataclass(frozen=True, eq=False)
class Point:
    """An arm with its energy."""

    place: ArmWithPayload
    residual: Array
    """Of the energy."""
    misfit: float
    """Mean square of the rows' part."""
    differentiate: Callable[[], Array]
    """Return the derivative of the residual by whitened steps, which most points do not need."""

    @cached_property
    def derivative(self) -> Array:
        """Return the derivative of the residual by whitened steps."""
        return self.differentiate()

    @property
    def energy(self) -> float:
        """Return the energy, nats."""
        return 0.5 * float(self.residual @ self.residual)


class Energy(Protocol):
    """An energy to minimise."""

    @property
    def carrier(self) -> Carrier:
        """Return the carrier of the arm."""

    def at(self, place: ArmWithPayload) -> Point:
        """Return the point of an arm."""


def minimum(problem: Energy, at: Point, rounds: int, shift: Array | float = 0.0) -> Point:
    """Run `descent` to its end and return the point."""
    steps = descent(problem, at, rounds, shift)
    while True:
        try:
            next(steps)
        except StopIteration as done:
            return cast(Point, done.value)


def descent(problem: Energy, at: Point, rounds: int, shift: Array | float = 0.0) -> Generator[None, None, Point]:
    """Minimise the energy in at most `rounds` steps; yield after each step. shift: target of the residuals."""
    damping, carrier = DRAWS.damping, problem.carrier
    for _ in range(rounds):
        off = at.residual - shift
        energy = 0.5 * float(off @ off)
        curvature, gradient = at.derivative.T @ at.derivative, at.derivative.T @ off
        while damping < DRAWS.max_damping:
            step = np.asarray(np.linalg.solve(curvature + damping * np.diag(np.diagonal(curvature)), -gradient))
            if (
                damping <= DRAWS.damping and -0.5 * float(gradient @ step) < DRAWS.min_gain_nats
            ):  # the gain if torque is linear
                return at
            trial = problem.at(at.place.moved(carrier, step))
            left = trial.residual - shift
            gained = energy - 0.5 * float(left @ left)
            if gained >= 0:
                break
            damping *= DRAWS.more
        else:
            break
        at, damping = trial, max(DRAWS.less * damping, DRAWS.min_damping)
        if gained < DRAWS.min_gain_nats:
            break
        yield
    return at


@dataclass(frozen=True, eq=False)
class Training:
    """The energy of the training of an arm. virtual: motions of its memory."""

    carrier: Carrier
    virtual: Instants

    @classmethod
    def of(cls, carrier: Carrier) -> Training:
        """Return the energy of a carrier's training."""
        motion = Motion.from_arrays(*carrier.memory.motions.swapaxes(0, 1))
        return cls(carrier, (motion, carrier.rest(motion)))

    def at(self, place: ArmWithPayload) -> Point:
        """Return the point of an arm, with its payload unchanged."""
        memory, size = self.carrier.memory, len(place.w)
        features, torque = rows_of(linearised_around(self.carrier, place, np.zeros(PARAMETERS)), *self.virtual)

        def derivative() -> Array:
            by_arm = memory.derivative(features[:size])
            out = np.zeros((len(by_arm) + PARAMETERS, size + PARAMETERS))
            out[: len(by_arm), :size] = by_arm
            out[len(by_arm) :, size:] = np.eye(PARAMETERS)
            return out

        residual = np.concatenate([memory.residual(place.w, torque), np.zeros(PARAMETERS)])
        return Point(place, residual, 0.0, derivative)

    def start_draw(self, number: int, draw: np.random.Generator) -> Generator[None, None, Draw]:
        """Return one of the arms that the training allows, with any payload; yield after each step.

        If the last axis is unidentified, the draw starts with it in one of six directions.
        """
        carrier = self.carrier
        geometry = carrier.term.arm.geometry.moved(carrier.step)
        learnt = ArmWithPayload(carrier.mean, geometry, ANY_PAYLOAD.centre)
        if carrier.is_tip_unidentified:
            return Draw(learnt.with_axis(geometry.n_joints - 1, number), None)  # equally likely a priori
        by = draw.uniform(*DRAWS.wide) * carrier.memory.root @ draw.standard_normal(len(carrier.mean))
        at = self.at(learnt.shifted(carrier, by, np.zeros(PARAMETERS)))
        noise = draw.standard_normal(len(at.residual))
        still = np.concatenate([noise[:-PARAMETERS], np.zeros(PARAMETERS)])
        at = yield from descent(self, at, DRAWS.steps, still)
        return Draw(at.place, noise)

    @cached_property
    def learnt_energy(self) -> float:
        """Return the energy of the arm as learnt, nats."""
        memory, mean = self.carrier.memory, self.carrier.mean
        alone = memory.residual(mean, memory.base + np.tensordot(mean, memory.features, axes=1))
        return 0.5 * float(alone @ alone)


def linearised_around(carrier: Carrier, place: ArmWithPayload, payload: Array) -> LinearisedCarrier:
    """Return the torque linearised around an arm with a payload, (10,)."""
    nothing = np.zeros((0, 0))
    return LinearisedCarrier(
        carrier, PayloadPosterior(np.append(place.w, payload), nothing, np.ones(PARAMETERS), place.geometry)
    )


def draw_arms(carrier: Carrier) -> Generator[None, None, tuple[Draw, ...]]:
    """Return the draws from the training alone, with any payload, from which estimates start; yield after each step.

    They are made once per version, by the first revision that needs them, and again if another revision has learnt more
    directions.
    """
    size = len(carrier.memory.slope) + len(carrier.memory.outside) + len(carrier.mean) + PARAMETERS
    known = _ARMS.get(carrier.term, ())
    if not known or not all(each.is_usable(size) for each in known):
        training, draw = Training.of(carrier), np.random.default_rng(DRAWS.seed)
        found = []
        for number in range(len(DIRECTIONS) if carrier.is_tip_unidentified else DRAWS.count):
            found.append((yield from training.start_draw(number, draw)))
        known = _ARMS[carrier.term] = tuple(found)
    return known


_ARMS: WeakKeyDictionary[ArmKernel, tuple[Draw, ...]] = WeakKeyDictionary()
