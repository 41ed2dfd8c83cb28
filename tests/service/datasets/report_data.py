"""Recordings with known properties, staged as uploads are, and a robot to compare them with."""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from lipcore.preparation.recipe import Recipe
from lipcore.robots.library import Robot, load_robot, profile_urdf
from lipcore.robots.simulation import inverse_dynamics
from service.contract.datasets import DatasetReport
from service.datasets.report.making import make_report
from service.datasets.staging import Staged, column, prepare
from service.foundation.settings import Settings
from service.storage.disk import Disk


@dataclass(frozen=True)
class FakeProfile:
    """A robot whose joints have their own names."""

    name: str
    joint_names: tuple[str, ...]
    joint_types: tuple[str, ...]
    lower: np.ndarray
    upper: np.ndarray
    speed: np.ndarray
    torque: np.ndarray
    urdf: str | None = None

    def match(self, names: Sequence[str]) -> tuple[int | None, ...]:
        return tuple(self.joint_names.index(name) if name in self.joint_names else None for name in names)


def profile_of(name: str, torque: float = np.nan) -> FakeProfile:
    robot = load_robot(name)
    limits = robot.lower, robot.upper, robot.speed, np.full(robot.n_joints, torque)
    return FakeProfile(name, robot.joint_names, robot.joint_types, *limits, urdf=profile_urdf(name))


def staged(folder: Path, names: tuple[str, ...], columns: Mapping[str, np.ndarray]) -> Staged:
    """Columns (N,), or tables (N, n) of a quantity, as `read` would stage them."""
    (folder / "raw").mkdir()
    out = Staged(folder / "raw", names, Disk(Settings(home=folder)))
    for name, values in columns.items():
        if values.ndim == 1:
            out.append({name: values})
        else:
            out.append({column(name, joint): values[:, joint] for joint in range(values.shape[1])})
    return out


def report_on(
    folder: Path,
    names: tuple[str, ...],
    columns: Mapping[str, np.ndarray],
    profile: FakeProfile | None = None,
    recipe: Recipe | None = None,
    **options: Any,
) -> DatasetReport:
    """The report of columns, made in a new folder."""
    folder, recipe = Path(tempfile.mkdtemp(dir=folder)), recipe or Recipe()
    raw = staged(folder, names, columns)
    prepared = prepare(raw, folder, recipe, 30, raw.disk)
    return DatasetReport.model_validate(make_report(raw, prepared, profile, ["read"], recipe, **options))


@dataclass(frozen=True)
class Swing:
    """Sums of sinusoids about the middle of a robot's range, exact at any time."""

    robot: Robot
    frequencies: np.ndarray
    phases: np.ndarray
    sizes: np.ndarray

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        w = 2 * np.pi * self.frequencies
        angle = t[:, None, None] * w + self.phases
        q = (self.robot.lower + self.robot.upper) / 2 + (self.sizes * np.sin(angle)).sum(1)
        return q, (self.sizes * w * np.cos(angle)).sum(1), (-self.sizes * w**2 * np.sin(angle)).sum(1)


def swing(name: str, seed: int, fastest: float = 1.5, reach: float = 1.0, waves: int = 8) -> Swing:
    robot = load_robot(name)
    rng = np.random.default_rng(seed)
    frequencies = rng.uniform(0.1, fastest, (waves, robot.n_joints))
    sizes = rng.uniform(0.3, 1.0, frequencies.shape) / frequencies
    return Swing(robot, frequencies, rng.uniform(0, 2 * np.pi, frequencies.shape), reach * sizes / sizes.sum(0))


@cache
def recording(
    name: str, seconds: float, rate: float, seed: int, late: float = 0.0, noise: float = 0.01, **options: Any
) -> dict[str, np.ndarray]:
    """t, q, dq, tau of a simulated robot whose torque comes `late` seconds after its motion."""
    move = swing(name, seed, **options)
    t = np.arange(int(seconds * rate)) / rate
    q, dq, _ = move.at(t)
    then = move.at(t - late)
    tau = inverse_dynamics(move.robot, *then) + 0.1 * then[1] + 0.2 * np.tanh(then[1] / 0.01)
    rng = np.random.default_rng(seed + 100)
    return {"t": t, "q": q, "dq": dq, "tau": tau + noise * rng.standard_normal(tau.shape)}
