"""What is played: a recording, or a simulated robot."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lipcore.data.samples import Array
from lipcore.robots.library import SimulationUnavailableError, load_robot
from lipcore.robots.simulation import FAST, Payload, Stream, simulate
from lipcore.vocabulary import TorqueConvention
from service.cli.errors import CommandError
from service.datasets.formats.opening import open_table
from service.datasets.mapping.reading import read
from service.datasets.options import UploadOptions
from service.datasets.preparing import prepare
from service.datasets.staging import Staged
from service.foundation.errors import ServiceError
from service.foundation.settings import Settings
from service.storage.disk import Disk

FEWEST = 10
"""Rows of a recording."""


@dataclass(frozen=True)
class Motion:
    """Rows to play. t: (N,) s; q, dq, ddq, tau: (N, n) in SI units, tau as measured."""

    t: Array
    q: Array
    dq: Array
    ddq: Array
    tau: Array
    joint_names: tuple[str, ...]
    torque_convention: TorqueConvention

    def __len__(self) -> int:
        return len(self.t)

    @property
    def step(self) -> float:
        """Usual time between two rows, s."""
        return float(np.median(np.diff(self.t)))

    def ordered(self, joint_names: Sequence[str]) -> tuple[Motion, bool]:
        """The motion in the order of a model's joints, and whether its names were these; raise CommandError.

        Joints of other names are taken in their order, where there are as many.
        """
        if len(joint_names) != len(self.joint_names):
            raise CommandError(
                f"the motion has {len(self.joint_names)} joints ({', '.join(self.joint_names)}), expected the model's "
                f"{len(joint_names)}: {', '.join(joint_names)}"
            )
        if set(joint_names) != set(self.joint_names):
            return self, False
        order = [self.joint_names.index(name) for name in joint_names]
        columns = {name: getattr(self, name)[:, order] for name in ("q", "dq", "ddq", "tau")}
        return replace(self, **columns, joint_names=tuple(joint_names)), True


def simulated(
    robot: str, seconds: float, rate: float, seed: int = 0, fast: bool = False, payload: float = 0.0, at: float = 0.0
) -> Motion:
    """A robot along random sinusoids, with a payload (kg) from a time (s) on where that is not 0.

    Raise CommandError where what simulates is not installed, ValueError for other robots.
    """
    stream = Stream(
        n_samples=max(2, round(seconds * rate)),
        rate=rate,
        speed=FAST if fast else 1.0,
        payload=Payload(payload, at) if payload else None,
    )
    try:
        made = simulate(load_robot(robot), stream, seed)
    except SimulationUnavailableError as error:
        raise CommandError(str(error)) from error
    return Motion(made.t, made.q, made.dq, made.ddq, made.tau, tuple(made.joint_names), "gravity_included")


def recorded(path: Path, seconds: float | None = None) -> Motion:
    """A recording, prepared as the service prepares an upload; its first seconds where these are given.

    Raise CommandError where it cannot be read or has no times.
    """
    with tempfile.TemporaryDirectory() as folder:
        try:
            staged, convention = _staged(path, Path(folder))
        except ServiceError as error:
            raise CommandError(f"{path.name}: {error}") from error
        t = staged.read("t")
        rows = slice(None) if seconds is None else t - t[0] <= seconds
        parts = {name: staged.table(name, rows) for name in ("q", "dq", "ddq", "tau")}
        names = staged.joint_names
    t = t[rows]
    if len(t) < 2 or not np.all(np.diff(t) > 0):
        raise CommandError(f"{path.name} has no times that rise from row to row, expected a column t in seconds")
    return Motion(t=t, **parts, joint_names=names, torque_convention=convention)


def _staged(path: Path, folder: Path) -> tuple[Staged, TorqueConvention]:
    """Columns of a recording in a folder, and what its torque is."""
    settings, options = Settings(home=folder, min_samples=FEWEST, max_home_bytes=None), UploadOptions()
    disk = Disk(settings)
    with open_table(path, None, options.read, settings) as table:
        found = read(table, folder, options, None, settings, disk)
    return prepare(found.staged, folder, options.recipe, FEWEST, disk).staged, found.torque_convention
