"""Recordings from which models of known quality are trained, good ones and bad ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lipcore.data.samples import Array, Samples
from lipcore.model.verdict import Level
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import inverse_dynamics
from tests.service.data import stream, train, upload

ROBOT = "double-pendulum"
ROWS, RATE = 1500, 50.0
LEARNT_SHARE = 0.7
FRICTION = {"viscous": 0.02, "coulomb": 0.02, "noise": 0.005}


@dataclass(frozen=True)
class Case:
    """A recording, and the verdict on a model that is trained on it."""

    record: Callable[[], Samples]
    """Makes the recording."""
    level: Level
    """Level of the verdict."""
    words: str
    """Part of the reason of the verdict."""
    model: str | None = None
    """Model that gets a version; None for a new model."""

    @property
    def serves(self) -> bool:
        """Whether the version serves by itself."""
        return self.level.startswith("usable")


def good(seed: int = 1, **options: Any) -> Samples:
    """Return a recording of varied motion over the whole range of the joints."""
    known = {"samples": ROWS, "rate": RATE, "speed": 5.0, "motion": "full", "seed": seed, **FRICTION}
    return stream(ROBOT, **{**known, **options})


def noise(samples: Samples, rows: slice, size: float) -> Samples:
    """Return a recording with white noise of this many N·m on the torque of some rows."""
    tau = samples.tau.copy()
    tau[rows] += size * np.random.default_rng(5).standard_normal(tau[rows].shape)
    return replace(samples, tau=tau)


def gravity(samples: Samples) -> Array:
    """Return the gravity torque of each sample, (N, n)."""
    still = np.zeros_like(samples.dq)
    return inverse_dynamics(load_robot(ROBOT), samples.q, still, still)


CUT = int(LEARNT_SHARE * ROWS)


def poisoned() -> Samples:
    """Return a recording with garbage in a third of the torques that are learnt."""
    samples, rng = good(), np.random.default_rng(6)
    tau = samples.tau.copy()
    rows = rng.permutation(CUT)[: CUT // 3]
    tau[rows] = 3.0 * rng.standard_normal((len(rows), tau.shape[1]))
    return replace(samples, tau=tau)


def at_rest() -> Samples:
    """Return a recording of 40 poses, held for half a second each, without motion."""
    samples = good()
    poses = np.repeat(samples.q[:: len(samples) // 40][:40], 25, axis=0)
    still = np.zeros_like(poses)
    tau = inverse_dynamics(load_robot(ROBOT), poses, still, still)
    tau += 0.02 * np.random.default_rng(7).standard_normal(tau.shape)
    count = len(poses)
    return Samples(samples.joint_names, np.arange(count) / RATE, np.zeros(count, np.int64), poses, still, still, tau)


def other_robot() -> Samples:
    """Return a recording of an arm with ten times the masses, whose joints have the same names."""
    samples = good(seed=8)
    return replace(samples, tau=10 * samples.tau)


def without_gravity() -> Samples:
    """Return a recording whose torque lacks gravity."""
    samples = good()
    return replace(samples, tau=samples.tau - gravity(samples))


CASES = {
    "good": Case(good, "usable", "on every joint, inside and outside the recorded range."),
    "wide": Case(lambda: noise(good(), slice(0, CUT), 1.0), "too_uncertain", "no narrower than those of the mean"),
    "narrow": Case(lambda: noise(good(), slice(CUT, None), 0.1), "wrong", "intervals are too narrow: joint1"),
    "mirrored-sign": Case(lambda: replace(good(), tau=good().tau * [1, -1]), "wrong", "joint2 has the opposite sign"),
    "wrong-order": Case(lambda: replace(good(), tau=good().tau[:, ::-1]), "wrong", "columns are in another order"),
    "gravity-missing": Case(without_gravity, "wrong", "lacks gravity"),
    "other-robot": Case(other_robot, "wrong", "is 10 and 10 times the torque", model="good"),
    "short": Case(lambda: good(samples=195), "not_judged", "s can be judged, at least 3 s are needed"),
    "repeated-motion": Case(lambda: good(course="periodic"), "usable_in_range", "% of the samples repeat"),
    "poisoned": Case(poisoned, "too_uncertain", "no narrower than those of the mean torque"),
    "worse-than-mean": Case(lambda: replace(good(), tau=good(seed=9).tau), "wrong", "no smaller than with the mean"),
    "at-rest-only": Case(at_rest, "usable_in_range", "the samples stand still"),
}
"""Models of known quality by name."""


def train_cases(api: Any) -> dict[str, dict[str, Any]]:
    """Train the model of each case with the default promotion; return its job."""
    jobs = {}
    for name, case in CASES.items():
        data = upload(api, case.record(), robot=ROBOT)["id"]
        request = {"estimator": "rigid-body", "robot": ROBOT, "options": {}, "promotion": None}
        holdout = {"share": 1 - LEARNT_SHARE, "kind": "last"}
        jobs[name] = train(api, case.model or name, data, holdout=holdout, **request)
    return jobs
