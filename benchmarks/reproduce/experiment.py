"""The experiment: its settings, its cells, and the computation of a cell."""

from __future__ import annotations

import hashlib
import json
import time
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict

import lipcore
from benchmarks.reproduce.memory import peak_mb, reset_peak
from lipcore.data.metrics import evaluate
from lipcore.data.samples import Array, Samples
from lipcore.estimators.catalogue import check_estimator
from lipcore.estimators.options import FitOptions
from lipcore.robots.library import Robot, load_robot
from lipcore.robots.simulation import Simulation, inverse_dynamics, simulate
from lipcore.robots.urdf import RigidBody
from lipcore.vocabulary import JointType

FIRST_TEST_SEED = 1000
"""First seed of the test sets, above those of training sets."""


class Cell(BaseModel):
    """One training: an estimator on `samples` samples of the stream of a seed and a speed."""

    model_config = ConfigDict(frozen=True)

    estimator: str
    speed: float
    samples: int
    seed: int

    def __str__(self) -> str:
        return f"{self.estimator}, speed {self.speed:g}, {self.samples} samples, seed {self.seed}"


class TestResult(BaseModel):
    """Figures of one test set, a value for each joint.

    Attributes:
        seed: seed of the test set.
        nmse: nMSE against the simulator's torque without noise.
        nmse_noisy: nMSE against the measured torque.
        torque_std: standard deviation of the torque without noise, N·m.
        coverage: coverage at each of `lipcore.data.metrics.LEVELS`.
        width: width of the interval at each of these levels, N·m.
    """

    model_config = ConfigDict(ser_json_inf_nan="constants")
    __test__ = False  # not a test for pytest

    seed: int
    nmse: list[float]
    nmse_noisy: list[float]
    torque_std: list[float]
    coverage: list[list[float]]
    width: list[list[float]]


class CellResult(BaseModel):
    """Result of a cell; reliability: coverage at each of RELIABILITY_LEVELS, per joint, over all test sets."""

    cell: Cell
    error: str | None = None
    fit_s: float = 0.0
    total_s: float = 0.0
    predict_ms: float = 0.0
    peak_mb: int | None = None
    iterations: int = 0
    converged: bool = False
    tests: list[TestResult] = []
    reliability: list[list[float]] = []


def fingerprint() -> str:
    """Return a short hash of lipcore's source."""
    total = hashlib.sha256()
    for path, content in sorted(_sources(files("lipcore"))):
        total.update(path.encode() + b"\0" + content)
    return total.hexdigest()[:12]


def _sources(folder: Traversable) -> list[tuple[str, bytes]]:
    found = []
    for entry in folder.iterdir():
        if entry.is_dir():
            found += [(f"{entry.name}/{path}", content) for path, content in _sources(entry)]
        elif entry.name.endswith(".py"):
            found.append((entry.name, entry.read_bytes()))
    return found


YARDSTICK = "rigid-body (URDF)"
"""Reference: `rigid-body` with the true geometry from the URDF; masses are learnt."""


@dataclass(frozen=True)
class Experiment:
    """Settings of all cells of one folder; see `lipcore.robots.simulation`.

    Attributes:
        robot: the simulated robot.
        samples: samples of each training and test set.
        rate: rate of the samples, Hz.
        training_sinusoids: sinusoids of training motions.
        test_sinusoids: sinusoids of test motions.
        noise: standard deviation of the measured torque, N·m.
        first_seed: seed of the first training set.
        test_sets: number of test sets.
        test_stride: distance of compared test samples.
        options: fit options.
        code: hash of lipcore's source, as other code gives other results.
    """

    robot: str = "panda"
    samples: int = 500
    rate: float = 10.0
    training_sinusoids: int = 50
    test_sinusoids: int = 100
    noise: float = 0.01
    first_seed: int = 1
    test_sets: int = 16
    test_stride: int = 1
    options: FitOptions = field(default_factory=lambda: FitOptions(prior="zero", device="cpu"))
    code: str = field(default_factory=fingerprint)

    def settings(self) -> dict[str, Any]:
        """Return the settings as JSON values."""
        settings: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return settings

    @property
    def hash(self) -> str:
        """Short hash of the settings."""
        return hashlib.sha256(json.dumps(self.settings(), sort_keys=True).encode()).hexdigest()[:12]

    def training_seeds(self, count: int) -> list[int]:
        """Return the seeds of the first `count` training sets."""
        return list(range(self.first_seed, self.first_seed + count))

    def test_seeds(self) -> list[int]:
        """Return the seeds of the test sets."""
        return [FIRST_TEST_SEED + seed for seed in self.training_seeds(self.test_sets)]

    def training_set(self, cell: Cell) -> Samples:
        """Return samples spread evenly over the whole stream of a cell, so that all sizes cover the same region."""
        stream = Simulation(self.samples, self.rate, self.training_sinusoids, speed=cell.speed, noise=self.noise)
        rows = np.linspace(0, self.samples - 1, cell.samples).round().astype(np.int64)
        return simulate(load_robot(self.robot), stream, cell.seed).rows(rows)

    def test_set(self, speed: float, seed: int) -> tuple[Samples, Array]:
        """Return every `test_stride`-th sample of a test stream, and the torque without noise, (N, n), N·m."""
        robot = load_robot(self.robot)
        stream = Simulation(self.samples, self.rate, self.test_sinusoids, speed=speed, noise=self.noise)
        samples = simulate(robot, stream, seed).rows(slice(None, None, self.test_stride))
        return samples, inverse_dynamics(robot, samples.q, samples.dq, samples.ddq)

    def check(self, estimators: list[str]) -> Robot:
        """Load the robot and check each estimator; raise the errors that a cell would raise."""
        robot = load_robot(self.robot)
        for name in estimators:
            check_estimator(*self.training(name, robot.joint_types))
        return robot

    def training(
        self, estimator: str, joint_types: tuple[JointType, ...]
    ) -> tuple[str, tuple[JointType, ...], RigidBody | None, FitOptions]:
        """Return estimator, joint types, robot and options for a name in the tables; YARDSTICK has a fixed geometry."""
        if estimator != YARDSTICK:
            return estimator, joint_types, None, self.options
        loaded = load_robot(self.robot)
        body = RigidBody.from_profile(self.robot, loaded.joint_names, loaded.joint_types)
        return "rigid-body", joint_types, body, replace(self.options, geometry="fixed")


def run_cell(experiment: Experiment, cell: Cell) -> CellResult:
    """Train once and compare with every test set; return an error as part of the result."""
    try:
        return _run(experiment, cell)
    except Exception as error:
        return CellResult(cell=cell, error=f"{type(error).__name__}: {error}")


def _run(experiment: Experiment, cell: Cell) -> CellResult:
    started = time.monotonic()
    types = load_robot(experiment.robot).joint_types
    estimator, types, robot, options = experiment.training(cell.estimator, types)
    training = experiment.training_set(cell)
    reset_peak()
    began = time.monotonic()
    model = lipcore.train(training, types, estimator, options, robot=robot)
    fit_s = time.monotonic() - began
    tests, curves, predict_s, compared = [], [], 0.0, 0
    for seed in experiment.test_seeds():
        samples, torque = _test_set(experiment, cell.speed, seed)
        began = time.monotonic()
        answer = model.predict(samples.q, samples.dq, samples.ddq)
        predict_s += time.monotonic() - began
        compared += len(samples)
        measured = evaluate(samples.tau, *answer.interval)
        true = evaluate(torque, *answer.interval)
        curves.append(measured.reliability)
        tests.append(
            TestResult(
                seed=seed,
                nmse=_short(true.nmse),
                nmse_noisy=_short(measured.nmse),
                torque_std=_short(torque.std(axis=0)),
                coverage=[_short(row) for row in measured.coverages],
                width=[_short(row) for row in measured.widths],
            )
        )
    return CellResult(
        cell=cell,
        fit_s=round(fit_s, 3),
        total_s=round(time.monotonic() - started, 3),
        predict_ms=round(1000 * predict_s / compared, 3),
        peak_mb=peak_mb(),
        iterations=int(model.fit["iterations"]),
        converged=bool(model.fit["converged"]),
        tests=tests,
        reliability=[_short(row) for row in np.mean(curves, axis=0)],
    )


@cache
def _test_set(experiment: Experiment, speed: float, seed: int) -> tuple[Samples, Array]:
    return experiment.test_set(speed, seed)


def _short(values: Array) -> list[float]:
    return [float(f"{value:.6g}") for value in values]
