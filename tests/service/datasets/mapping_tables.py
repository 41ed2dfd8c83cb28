"""Recordings in memory as tables, and a robot with named joints."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from service.datasets.formats.table import Table
from service.datasets.options import ReadOptions, UploadOptions

RATE = 100.0


def motion(rows: int = 200, n: int = 2, seed: int = 3) -> dict[str, np.ndarray]:
    """Return t (N,) and q, dq, ddq, tau (N, n): sinusoids with exact derivatives, and smooth torques."""
    rng = np.random.default_rng(seed)
    t = np.arange(rows) / RATE
    rate, phase, size = rng.uniform(2, 6, n), rng.uniform(0, 6, n), rng.uniform(0.3, 1.0, n)
    angle = t[:, None] * rate + phase
    return {
        "t": t,
        "q": size * np.sin(angle),
        "dq": size * rate * np.cos(angle),
        "ddq": -size * rate**2 * np.sin(angle),
        "tau": 5 * np.cos(0.7 * angle),
    }


def canonical(data: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return columns by their documented names."""
    out = {}
    for name, values in data.items():
        if values.ndim == 1:
            out[name] = values
        else:
            out |= {f"{name}{joint}": column for joint, column in enumerate(values.T, start=1)}
    return out


def table(columns: Mapping[str, np.ndarray], block: int = 64, **kwargs) -> Table:
    """Return a table of these columns in blocks of `block` rows."""
    entire = np.column_stack([np.asarray(each, dtype=np.float64) for each in columns.values()])

    def blocks() -> Iterator[np.ndarray]:
        for start in range(0, len(entire), block):
            yield entire[start : start + block].copy()

    return Table(tuple(columns), blocks(), **kwargs)


def options(joints=None, drop_joints=(), robot=None, torque_convention=None, **read) -> UploadOptions:
    """Return the options of an upload."""
    return UploadOptions(
        ReadOptions(**read), joints=joints, drop_joints=drop_joints, robot=robot, torque_convention=torque_convention
    )


@dataclass(frozen=True)
class Arm:
    """A robot for tests."""

    joint_names: tuple[str, ...]
    effort: str = "unknown"
    torque_constants: tuple[float, ...] | None = None
    name: str = "arm"

    def list_assignments(self, names):
        return []

    def order_of(self, names):
        return [list(names).index(each) for each in self.joint_names] if set(self.joint_names) <= set(names) else None
