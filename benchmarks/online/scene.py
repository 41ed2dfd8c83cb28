"""A simulated robot in random motion, with drifting friction and a payload attached on the way."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lipcore.data import independence
from lipcore.data.samples import Array, Samples
from lipcore.online.batch import Rows
from lipcore.robots.library import Robot, load_robot
from lipcore.robots.simulation import Payload, Simulation, simulate
from lipcore.vocabulary import Code

SINUSOIDS, UNSEEN_SINUSOIDS = 50, 100
"""The test trajectory has twice the bandwidth, as in the paper's tests."""
UNSEEN_SAMPLES, UNSEEN_RATE = 500, 10.0
_HISTORY, _LIVE, _UNSEEN, _NOISE, _MORE, _FLEET = range(6)
_SEEDS = 100
"""Distance between the random seeds of two successive scenes."""


@dataclass(frozen=True)
class Scene:
    """A simulated robot that moves ±0.5 rad about the middle of its joints.

    Attributes:
        robot: name of the robot.
        seconds: length of the live stream.
        change_at: time at which the payload is attached, s.
        rate: rate of the live stream, Hz.
        speed: factor on the frequencies of the motion.
        noise: standard deviation of the measured torque, N·m.
        viscous: initial viscous friction of every joint, N·m·s/rad.
        coulomb: initial Coulomb friction of every joint, N·m.
        drift: relative linear growth of friction over the live stream.
        payload: mass of the payload, kg.
        seed: seed of all random numbers.
    """

    robot: str = "panda"
    seconds: float = 60.0
    change_at: float = 30.0
    rate: float = 1000.0
    speed: float = 5.0
    noise: float = 0.05
    viscous: float = 0.5
    coulomb: float = 0.3
    drift: float = 0.3
    payload: float = 1.5
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 < self.change_at < self.seconds:
            raise ValueError(f"change_at is {self.change_at:g} s, expected a time between 0 and {self.seconds:g} s")

    @cached_property
    def arm(self) -> Robot:
        """The simulated robot."""
        return load_robot(self.robot)

    def history(self, seconds: float, rate: float) -> Samples:
        """Return earlier motion without payload and drift; its time ends at the start of the live stream."""
        samples = self._measured(self._moving(_HISTORY, round(seconds * rate), rate), 1.0, _NOISE)
        return replace(samples, t=samples.t - seconds)

    def live(self) -> Samples:
        """Return the live stream."""
        samples = self._moving(_LIVE, round(self.seconds * self.rate), self.rate, self.change_at)
        return self._measured(samples, self.friction(samples.t)[:, None], _NOISE + _SEEDS // 2)

    def more(self, seconds: float) -> Samples:
        """Return another stream without payload and drift."""
        return self._measured(self._moving(_MORE, round(seconds * self.rate), self.rate), 1.0, _MORE + _SEEDS // 2)

    def fleet(self, robots: int, samples: int, rate: float) -> list[Samples]:
        """Return streams of several robots without payload and drift."""
        parts = [self._moving(_FLEET + number, samples, rate) for number in range(robots)]
        return [self._measured(part, 1.0, _FLEET + _SEEDS // 2 + number) for number, part in enumerate(parts)]

    def unseen(self, at: float) -> Samples:
        """Return a test trajectory under the dynamics at a time of the live stream, torque without noise.

        It has the payload if `at` is later than `change_at`.
        """
        loaded = 0.0 if at > self.change_at else None
        samples = self._moving(_UNSEEN, UNSEEN_SAMPLES, UNSEEN_RATE, loaded, UNSEEN_SINUSOIDS)
        return self._with_friction(samples, float(self.friction(np.array(at))))

    def measured(self, unseen: Samples) -> Array:
        """Return the torques of a test trajectory with noise, (N, n)."""
        rng = np.random.default_rng(self._seed(_UNSEEN + _SEEDS // 2))
        noisy: Array = unseen.tau + self.noise * rng.standard_normal(unseen.tau.shape)
        return noisy

    def friction(self, t: Array) -> Array:
        """Return the factor on friction at times of the live stream."""
        factor: Array = 1 + self.drift * t / self.seconds
        return factor

    def _moving(
        self, part: int, count: int, rate: float, loaded: float | None = None, sinusoids: int = SINUSOIDS
    ) -> Samples:
        """Simulate rigid bodies without friction and noise, with the payload from time `loaded` on."""
        payload = None if loaded is None else Payload(self.payload, loaded)
        stream = Simulation(count, rate, sinusoids, speed=self.speed, noise=0.0, payload=payload)
        return simulate(self.arm, stream, self._seed(part))

    def _measured(self, samples: Samples, factor: Array | float, part: int) -> Samples:
        samples = self._with_friction(samples, factor)
        rng = np.random.default_rng(self._seed(part))
        return replace(samples, tau=samples.tau + self.noise * rng.standard_normal(samples.tau.shape))

    def _with_friction(self, samples: Samples, factor: Array | float) -> Samples:
        friction = self.viscous * samples.dq + self.coulomb * np.sign(samples.dq)
        return replace(samples, tau=samples.tau + factor * friction)

    def _seed(self, part: int) -> int:
        return _SEEDS * self.seed + part


def rows_of(samples: Samples) -> Rows:
    """Return all samples as rows to learn."""
    code: NDArray[np.uint8] = np.full(len(samples), Code.LEARNT, dtype=np.uint8)
    return Rows(samples.t, samples.q, samples.dq, samples.ddq, samples.tau, code, independence.even_weights(samples.t))
