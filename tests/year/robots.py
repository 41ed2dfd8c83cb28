"""The robots of a laboratory: their motion, their clocks and the batches that they send."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from random import Random
from typing import Any

import numpy as np

from lipcore.data.samples import Samples
from tests.service.data import stream

RATE, BATCHES, ROWS = 100.0, 4, 500
"""Rows per second; batches of a day; rows of a batch."""
ARMS = ("double-pendulum", "double-pendulum", "ur5", "double-pendulum", "asr-twodof", "double-pendulum", "panda")
"""Arms of the robots, in turn. The first two robots are those of the models of release 0.2.0."""
ESTIMATORS = {"ur5": "rigid-body", "panda": "rigid-body"}
"""Estimators of new models; the others have `lip-chain`."""
NOISE, VISCOUS = 0.02, 0.1
"""Standard deviation of the torque's noise, N·m; viscous friction of every joint, N·m·s/rad."""


@cache
def recording(arm: str) -> Samples:
    """Return a recording of an arm, from which all robots with this arm take their motion."""
    return stream(arm, 4000, seed=31, rate=RATE, noise=0.0, viscous=VISCOUS)


@dataclass
class Robot:
    """A robot with a model and a stream of its own. Its clock has an arbitrary origin, which it knows nothing of.

    epoch: origin of its clock, Unix time, s. sequence: of its next batch. streams: number of its streams so far.
    friction: viscous friction that has been added since the model was trained, N·m·s/rad.
    """

    model: str
    arm: str
    random: Random
    epoch: float
    sequence: int = 0
    streams: int = 1
    friction: float = 0.0
    measures_acceleration: bool = True

    @property
    def stream_id(self) -> str:
        """Name of the current stream."""
        return f"{self.model}-{self.streams}"

    @property
    def joints(self) -> int:
        """Number of joints."""
        return recording(self.arm).q.shape[1]

    def start_stream(self) -> None:
        """Continue with a new stream, as after the robot's clock was set."""
        self.streams += 1
        self.sequence = 0

    def set_clock(self, seconds: float) -> None:
        """Set the robot's clock ahead, or back if negative."""
        self.epoch -= seconds

    def batch(self, now: float) -> dict[str, Any]:
        """Return the next batch, whose last row was measured at a Unix time, s."""
        samples, first = recording(self.arm), self.random.randrange(4000 - ROWS)
        part = slice(first, first + ROWS)
        rng = np.random.default_rng(self.random.randrange(2**32))
        tau = samples.tau[part] + self.friction * samples.dq[part]
        body = {
            "q": samples.q[part],
            "dq": samples.dq[part],
            "ddq": samples.ddq[part],
            "tau": tau + NOISE * rng.standard_normal(tau.shape),
        }
        times = now - self.epoch - np.arange(ROWS)[::-1] / RATE
        sent = {"stream_id": self.stream_id, "sequence": self.sequence, "t": times.tolist()}
        self.sequence += 1
        if not self.measures_acceleration:
            del body["ddq"]
        return sent | {name: values.tolist() for name, values in body.items()}

    def queries(self) -> dict[str, Any]:
        """Return queries at fixed points of the motion."""
        samples = recording(self.arm)
        return {name: getattr(samples, name)[100:200:20].tolist() for name in ("q", "dq", "ddq")}
