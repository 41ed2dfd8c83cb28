"""Arms that take something up and put it down: their motion, simulated, and models of them."""

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
"""Hz of the streams; N·m of the clean simulator's torque."""
MASSES: tuple[float, ...] = (0.3, 1.0, 3.0)
PLACES = {"centred": (0.0, 0.0, 0.1), "off-centre": (0.05, 0.03, 0.08)}
"""Where the payload is in the frame of the last link, m."""
SPEEDS = {"slow": 1.0, "fast": 5.0}
SECONDS, UP, DOWN = 10.0, 3.0, 7.0
"""Of a stream; when its payload is taken up, and put down."""
SIMULATED = 30.0
"""s of motion, of which the last are taken: a short motion is stretched over the joints' whole range, and violent."""
EDGE_S = 1.0
"""s that are left out at the end, and of quiet motion at the beginning: filters without delay see nothing beyond it."""
UNSEEN_S, UNSEEN_EVERY = 20.0, 10
"""s of the motion that is asked for, and of how many of its rows one is."""
TRAINED_S = 60.0
"""s of motion that a model of a dirty arm is trained on."""
_SEEDS = 1000
"""Between what is drawn of one seed and of the next."""


@dataclass(frozen=True)
class Case:
    """Who takes up what, and how it moves. number: of the case, which its motion is drawn by."""

    robot: str
    kind: Kind
    mass: float
    place: str
    speed: str
    number: int

    @property
    def payload(self) -> Payload:
        """What is carried, from the start on."""
        return Payload(self.mass, 0.0, PLACES[self.place])


@dataclass(frozen=True)
class Arm:
    """A simulated arm of one kind."""

    name: str
    kind: Kind
    seed: int

    @cached_property
    def robot(self) -> Robot:
        """Its bodies and joints."""
        return load_robot(self.name)

    @property
    def dirt(self) -> Dirt | None:
        """Of a dirty one."""
        return None if self.kind == "clean" else Dirt(seed=self.seed)

    def trained(self) -> TorqueModel:
        """A model of rigid bodies, learnt from torque alone or, for `dirty+urdf`, calibrated around the URDF."""
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
        """The last so many seconds of a motion, at RATE, from time 0 on. payload: carried all the time."""
        end = round(max(SIMULATED, seconds) * RATE)
        dirt = self.dirt
        count, noise = end + round(EDGE_S * RATE), noise if dirt is None else 0.0
        stream = Simulation(count, RATE, speed=speed, noise=noise, payload=payload, dirt=dirt)
        samples = simulate(self.robot, stream, _SEEDS * self.seed + part)
        last = samples.rows(slice(end - round(seconds * RATE), end))
        return replace(last, t=last.t - last.t[0])

    def live(self, case: Case) -> Samples:
        """The stream of a case: the same motion with its payload from UP to DOWN, and else without."""
        speed = SPEEDS[case.speed]
        free, loaded = (self.moving(SECONDS, speed, case.number, each) for each in (None, case.payload))
        carries = (free.t >= UP - 0.5 / RATE) & (free.t < DOWN - 0.5 / RATE)
        return replace(free, tau=np.where(carries[:, None], loaded.tau, free.tau))

    def unseen(self, case: Case, carries: bool) -> tuple[Samples, Array]:
        """Another motion with or without the payload, and its torque as measured, (N, n).

        The samples' torque has no noise on the clean arm, and is the measured one of a dirty arm.
        """
        payload = case.payload if carries else None
        speed, part = SPEEDS[case.speed], _SEEDS // 2 + case.number
        every = slice(None, None, UNSEEN_EVERY)
        exact = self.moving(UNSEEN_S, speed, part, payload, 0.0).rows(every)
        if self.dirt is not None:
            return exact, exact.tau
        return exact, self.moving(UNSEEN_S, speed, part, payload).tau[every]


def cases(robot: str, kind: Kind) -> list[Case]:
    """All that one arm is tried with."""
    every = [(mass, place, speed) for speed in SPEEDS for mass in MASSES for place in PLACES]
    return [Case(robot, kind, *each, number) for number, each in enumerate(every, start=1)]
