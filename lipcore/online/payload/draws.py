"""Arms that the training of a version allows: their energy, its minima, and draws from the posterior.

A draw is the place of least energy for other noise (randomised maximum likelihood, Kitanidis 1995, Oliver et al. 1996).
Those of the training alone are made once; rows with a payload move them on (`payload`).
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, cast
from weakref import WeakKeyDictionary

import numpy as np

from lipcore.arm.right_angles import DIRECTIONS, laid_out
from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.geometry import Geometry
from lipcore.model.payload import Carrier, Linearised, Load
from lipcore.online.payload.bodies import ANY, WIDTH
from lipcore.online.payload.estimate import Seen, rows_of
from lipcore.robots.urdf import PARAMETERS


@dataclass(frozen=True)
class DrawOptions:
    """Steps of a descent, and draws from the posterior, which show how far it is from linear."""

    min_gain_nats: float = 0.01
    """Min gain of a step after which another one follows."""
    damping: float = 1e-3
    """Damping of the first step, as a share of the curvature."""
    less: float = 0.15
    more: float = 8.0
    """Factors on the damping after a step that gains, and after one that does not."""
    min_damping: float = 1e-9
    max_damping: float = 1e8
    """From the max on nothing is gained."""
    max_step: float = 0.5
    """Max step of the geometry, rad or m."""
    count: int = 10
    """Draws, followed from estimate to estimate."""
    wide: tuple[float, float] = (1.0, 6.0)
    """Range of the deviations of the linear posterior at which draws begin: where the posterior bends, it is wider."""
    steps: int = 20
    """Max steps in which draws become arms that the training allows."""
    seed: int = 0


DRAWS = DrawOptions()


@dataclass(frozen=True, eq=False)
class Place:
    """An arm and its payload. w: (M,); geometry: of the arm; eta: (10,)."""

    w: Array
    geometry: Geometry
    eta: Array

    def moved(self, carrier: Carrier, step: Array) -> Place:
        """The place a whitened step away, (M + 10,), or as far in its direction as is gone at once."""
        size, steps = len(self.w), carrier.steps
        by, eta = carrier.memory.root @ step[:size], step[size:]
        longest = max(np.abs(eta / WIDTH).max() / 2, np.abs(carrier.root[steps] * by[steps]).max() / DRAWS.max_step)
        return self.shifted(carrier, by / max(1.0, longest), eta / max(1.0, longest))

    def shifted(self, carrier: Carrier, by: Array, eta: Array) -> Place:
        """The place where w is larger by (M,), its geometry moved as far, and η by (10,)."""
        steps, learnt = carrier.steps, carrier.term.arm.geometry
        w, geometry = self.w + by, self.geometry.moved(carrier.root[steps] * by[steps])
        # steps do not add up where they are large
        w[steps] = self.w[steps] + (learnt.towards(geometry) - learnt.towards(self.geometry)) / carrier.root[steps]
        return Place(w, geometry, self.eta + eta)


@dataclass(frozen=True, eq=False)
class Draw:
    """A draw from the posterior: the minimum of the energy whose residuals are shifted by noise.

    noise: of the training and of the payload's prior; None: no noise, so that it is a minimum of the energy itself.
    """

    place: Place
    noise: Array | None

    def usable(self, size: int) -> bool:
        """Whether its noise is of so many numbers, as of the same revision."""
        return self.noise is None or len(self.noise) == size


@dataclass(frozen=True, eq=False)
class Point:
    """The energy of a place. residual: of it; misfit: mean square of the rows' part; differentiate: gives the
    residual's derivative by whitened steps, of which most places are not asked."""

    place: Place
    residual: Array
    misfit: float
    differentiate: Callable[[], Array]

    @cached_property
    def derivative(self) -> Array:
        """Of the residual, by whitened steps."""
        return self.differentiate()

    @property
    def energy(self) -> float:
        """Nats."""
        return 0.5 * float(self.residual @ self.residual)


class Energy(Protocol):
    """What is minimised."""

    @property
    def carrier(self) -> Carrier:
        """Whose arm it is."""

    def at(self, place: Place) -> Point:
        """The energy of a place."""


def minimum(problem: Energy, at: Point, rounds: int, shift: Array | float = 0.0) -> Point:
    """Where the energy is least, or what is reached in so many steps; shift: what the residuals should be."""
    steps = descent(problem, at, rounds, shift)
    while True:
        try:
            next(steps)
        except StopIteration as done:
            return cast(Point, done.value)


def descent(problem: Energy, at: Point, rounds: int, shift: Array | float = 0.0) -> Generator[None, None, Point]:
    """The same; it yields after each step."""
    damping, carrier = DRAWS.damping, problem.carrier
    for _ in range(rounds):
        off = at.residual - shift
        energy = 0.5 * float(off @ off)
        curvature, gradient = at.derivative.T @ at.derivative, at.derivative.T @ off
        while damping < DRAWS.max_damping:
            step = np.asarray(np.linalg.solve(curvature + damping * np.diag(np.diagonal(curvature)), -gradient))
            if (
                damping <= DRAWS.damping and -0.5 * float(gradient @ step) < DRAWS.min_gain_nats
            ):  # what it gains where torque is linear
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
    """What the training of an arm says. virtual: motions of its memory."""

    carrier: Carrier
    virtual: Seen

    @classmethod
    def of(cls, carrier: Carrier) -> Training:
        """That of a carrier."""
        motion = Motion.from_arrays(*carrier.memory.motions.swapaxes(0, 1))
        return cls(carrier, (motion, carrier.rest(motion)))

    def at(self, place: Place) -> Point:
        """The energy of a place, whose payload is left as it is."""
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

    def begun(self, number: int, draw: np.random.Generator) -> Generator[None, None, Draw]:
        """One of the arms that the training allows, with any payload; it yields after each step. Where the last axis is
        open, it points in one of six directions, and a valley is sought from there."""
        carrier = self.carrier
        geometry = carrier.term.arm.geometry.moved(carrier.step)
        learnt = Place(carrier.mean, geometry, ANY.centre)
        if carrier.open_tip:
            layout = (*[None] * (geometry.n_joints - 1), number % len(DIRECTIONS))
            return Draw(replace(learnt, geometry=laid_out(geometry, layout)), None)  # which is as likely beforehand
        by = draw.uniform(*DRAWS.wide) * carrier.memory.root @ draw.standard_normal(len(carrier.mean))
        at = self.at(learnt.shifted(carrier, by, np.zeros(PARAMETERS)))
        noise = draw.standard_normal(len(at.residual))
        still = np.concatenate([noise[:-PARAMETERS], np.zeros(PARAMETERS)])
        at = yield from descent(self, at, DRAWS.steps, still)
        return Draw(at.place, noise)

    @cached_property
    def alone(self) -> float:
        """Energy of the arm as it was learnt, nats."""
        memory, mean = self.carrier.memory, self.carrier.mean
        alone = memory.residual(mean, memory.base + np.tensordot(mean, memory.features, axes=1))
        return 0.5 * float(alone @ alone)


def linearised_around(carrier: Carrier, place: Place, payload: Array) -> Linearised:
    """Torque around a place that carries a payload, (10,)."""
    nothing = np.zeros((0, 0))
    return Linearised(carrier, Load(np.append(place.w, payload), nothing, np.ones(PARAMETERS), place.geometry))


def arms(carrier: Carrier) -> Generator[None, None, tuple[Draw, ...]]:
    """Where draws begin: what the training alone says, with any payload; made once a version, by the revision that asks
    first, and again where another has learnt more directions. It yields after each step."""
    size = len(carrier.memory.slope) + len(carrier.memory.outside) + len(carrier.mean) + PARAMETERS
    known = _ARMS.get(carrier.term, ())
    if not known or not all(each.usable(size) for each in known):
        training, draw = Training.of(carrier), np.random.default_rng(DRAWS.seed)
        found = []
        for number in range(len(DIRECTIONS) if carrier.open_tip else DRAWS.count):
            found.append((yield from training.begun(number, draw)))
        known = _ARMS[carrier.term] = tuple(found)
    return known


_ARMS: WeakKeyDictionary[ArmKernel, tuple[Draw, ...]] = WeakKeyDictionary()
