"""What the experiment is: its settings, its cells, and how one cell is computed."""

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
"""Test sets have the seeds from here on, so that none is a training set."""


class Cell(BaseModel):
    """One training: an estimator on `samples` samples of the stream of a seed, at a speed. Tested on every test set."""

    model_config = ConfigDict(frozen=True)

    estimator: str
    speed: float
    samples: int
    seed: int

    def __str__(self) -> str:
        return f"{self.estimator}, speed {self.speed:g}, {self.samples} samples, seed {self.seed}"


class TestResult(BaseModel):
    """Figures of one test set, one number a joint; coverage and width one list for each of data.metrics.LEVELS.

    nmse is against the simulator's torque without noise, nmse_noisy against the measured one; torque_std, N·m, is the
    standard deviation of the former.
    """

    model_config = ConfigDict(ser_json_inf_nan="constants")
    __test__ = False  # no test, whatever pytest thinks

    seed: int
    nmse: list[float]
    nmse_noisy: list[float]
    torque_std: list[float]
    coverage: list[list[float]]
    width: list[list[float]]


class CellResult(BaseModel):
    """What became of a cell. reliability: coverage at each of RELIABILITY_LEVELS, per joint, over all test sets."""

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
    """Short hash of lipcore's source: results of other code are other results."""
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
"""The arm whose geometry is that of the URDF, which is the simulator's own; its masses are learnt."""


@dataclass(frozen=True)
class Experiment:
    """What all cells of one folder share. Streams are the paper's but for what is said here; see lipcore.simulation.

    samples, rate (Hz), noise (N·m): of training and test sets; test_stride: every how many test samples are compared;
    options: of the fits; code: fingerprint of the numerics, since other code gives other results.
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
        """The settings as JSON holds them."""
        settings: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return settings

    @property
    def hash(self) -> str:
        """Short hash of the settings."""
        return hashlib.sha256(json.dumps(self.settings(), sort_keys=True).encode()).hexdigest()[:12]

    def training_seeds(self, count: int) -> list[int]:
        """Seeds of the first `count` training sets."""
        return list(range(self.first_seed, self.first_seed + count))

    def test_seeds(self) -> list[int]:
        """Seeds of the test sets."""
        return [FIRST_TEST_SEED + seed for seed in self.training_seeds(self.test_sets)]

    def training_set(self, cell: Cell) -> Samples:
        """Samples spread evenly over the whole stream of a cell, so that fewer samples see the same region."""
        stream = Simulation(self.samples, self.rate, self.training_sinusoids, speed=cell.speed, noise=self.noise)
        rows = np.linspace(0, self.samples - 1, cell.samples).round().astype(np.int64)
        return simulate(load_robot(self.robot), stream, cell.seed).rows(rows)

    def test_set(self, speed: float, seed: int) -> tuple[Samples, Array]:
        """Every `test_stride`-th sample of a test stream and its torque without noise, (N, n) N·m."""
        robot = load_robot(self.robot)
        stream = Simulation(self.samples, self.rate, self.test_sinusoids, speed=speed, noise=self.noise)
        samples = simulate(robot, stream, seed).rows(slice(None, None, self.test_stride))
        return samples, inverse_dynamics(robot, samples.q, samples.dq, samples.ddq)

    def check(self, estimators: list[str]) -> Robot:
        """Load the robot and check each estimator; raise what a cell would raise, before any work."""
        robot = load_robot(self.robot)
        for name in estimators:
            check_estimator(*self.training(name, robot.joint_types))
        return robot

    def training(
        self, estimator: str, joint_types: tuple[JointType, ...]
    ) -> tuple[str, tuple[JointType, ...], RigidBody | None, FitOptions]:
        """Estimator, joint types, robot and options that a name in the tables is trained with.

        Arms of rigid bodies are learnt from torque alone; YARDSTICK is told where the joints lie.
        """
        if estimator != YARDSTICK:
            return estimator, joint_types, None, self.options
        loaded = load_robot(self.robot)
        body = RigidBody.from_profile(self.robot, loaded.joint_names, loaded.joint_types)
        return "rigid-body", joint_types, body, replace(self.options, geometry="fixed")


def run_cell(experiment: Experiment, cell: Cell) -> CellResult:
    """Train once, compare with every test set. A failure is part of the result: other cells go on."""
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
