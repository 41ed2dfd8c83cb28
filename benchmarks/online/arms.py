"""Simulated arms that pick up and release payloads, and models of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

import lipcore
from benchmarks.studies.dirty_arms import prepared, recording
from lipcore.data.samples import Array, Samples
from lipcore.model.torque_model import TorqueModel
from lipcore.robots.dirt import Dirt
from lipcore.robots.library import Robot, load_robot
from lipcore.robots.simulation import FAST_SPEED, Payload, Simulation, simulate
from lipcore.robots.urdf import RigidBody

Kind = Literal["clean", "dirty", "dirty+urdf"]
KINDS: tuple[Kind, ...] = ("clean", "dirty", "dirty+urdf")
RATE, NOISE = 100.0, 0.05
"""Rate of the streams, Hz, and noise of a clean arm's torque, N·m."""
MASSES: tuple[float, ...] = (0.3, 1.0, 3.0)
PLACES = {"centred": (0.0, 0.0, 0.1), "off-centre": (0.05, 0.03, 0.08)}
"""Position of the payload in the frame of the last link, m."""
SPEEDS = {"slow": 1.0, "fast": 5.0}
SECONDS, UP, DOWN = 10.0, 3.0, 7.0
"""Length of a stream; times of pick-up and release, s."""
SIMULATED_S = 30.0
"""Min simulated motion, of which the end is used; a shorter motion would span the joints' range too fast."""
EDGE_S = 1.0
"""Time omitted at the end, and at the start of motion without payload, where filters without delay lack data."""
UNSEEN_S, UNSEEN_EVERY = 20.0, 10
"""Length of the test motion, and distance of its rows."""
TRAINED_S = 60.0
"""Training motion of a dirty arm."""
_SEEDS = 1000
"""Distance between the random seeds of two successive seeds."""


@dataclass(frozen=True)
class Case:
    """An arm, its payload and its speed; number: seed of the motion."""

    robot: str
    kind: Kind
    mass: float
    place: str
    speed: str
    number: int

    @property
    def payload(self) -> Payload:
        """The payload, carried from time 0."""
        return Payload(self.mass, 0.0, PLACES[self.place])


@dataclass(frozen=True)
class Arm:
    """A simulated arm of one kind."""

    name: str
    kind: Kind
    seed: int

    @cached_property
    def robot(self) -> Robot:
        """Bodies and joints."""
        return load_robot(self.name)

    @property
    def dirt(self) -> Dirt | None:
        """Dirt; None for a clean arm."""
        return None if self.kind == "clean" else Dirt(seed=self.seed)

    def trained(self) -> TorqueModel:
        """Train a `rigid-body` model from torque alone or, for `dirty+urdf`, calibrated around the URDF."""
        robot, seed = self.robot, _SEEDS * self.seed
        if (dirt := self.dirt) is None:
            samples = simulate(robot, Simulation(speed=FAST_SPEED, noise=NOISE, motion="full"), seed)
        else:
            samples = prepared(simulate(robot, recording(TRAINED_S, dirt), seed))
        if self.kind != "dirty+urdf":
            return lipcore.train(samples, robot.joint_types, "rigid-body")
        body = RigidBody.from_profile(self.name, robot.joint_names, robot.joint_types)
        options = lipcore.FitOptions(geometry="calibrate")
        return lipcore.train(samples, robot.joint_types, "rigid-body", options, robot=body)

    def moving(self, seconds: float, speed: float, part: int, payload: Payload | None, noise: float = NOISE) -> Samples:
        """Return the last `seconds` of a motion with this payload all the time, at RATE from time 0."""
        end = round(max(SIMULATED_S, seconds) * RATE)
        dirt = self.dirt
        count, noise = end + round(EDGE_S * RATE), noise if dirt is None else 0.0
        stream = Simulation(count, RATE, speed=speed, noise=noise, payload=payload, dirt=dirt)
        samples = simulate(self.robot, stream, _SEEDS * self.seed + part)
        last = samples.rows(slice(end - round(seconds * RATE), end))
        return replace(last, t=last.t - last.t[0])

    def live(self, case: Case) -> Samples:
        """Return the stream of a case, with the payload from UP to DOWN."""
        speed = SPEEDS[case.speed]
        free, loaded = (self.moving(SECONDS, speed, case.number, each) for each in (None, case.payload))
        carries = (free.t >= UP - 0.5 / RATE) & (free.t < DOWN - 0.5 / RATE)
        return replace(free, tau=np.where(carries[:, None], loaded.tau, free.tau))

    def unseen(self, case: Case, carries: bool) -> tuple[Samples, Array]:
        """Return another motion with or without the payload, and its measured torque, (N, n).

        The torque of the samples has no noise for a clean arm, and is the measured torque for a dirty one.
        """
        payload = case.payload if carries else None
        speed, part = SPEEDS[case.speed], _SEEDS // 2 + case.number
        every = slice(None, None, UNSEEN_EVERY)
        exact = self.moving(UNSEEN_S, speed, part, payload, 0.0).rows(every)
        if self.dirt is not None:
            return exact, exact.tau
        return exact, self.moving(UNSEEN_S, speed, part, payload).tau[every]


def cases(robot: str, kind: Kind) -> list[Case]:
    """Return all cases of one arm."""
    every = [(mass, place, speed) for speed in SPEEDS for mass in MASSES for place in PLACES]
    return [Case(robot, kind, *each, number) for number, each in enumerate(every, start=1)]
