"""Simulated recordings of a Panda of any length, in shards with separate trajectories."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lipcore.data.samples import Samples
from lipcore.robots.library import Robot, load_robot
from lipcore.robots.simulation import Simulation, simulate

ROBOT = "panda"
SPEED, NOISE, VISCOUS, COULOMB = 5.0, 0.05, 0.5, 0.3
RATE = 100.0
SHARD_ROWS = 100_000
_SEEDS = 1000


def robot() -> Robot:
    """Return the robot of all parts."""
    return load_robot(ROBOT)


def stream(rows: int, seed: int, rate: float = RATE) -> Samples:
    """Return one trajectory with friction and noise."""
    motion = Simulation(rows, rate, speed=SPEED, noise=NOISE, viscous=VISCOUS, coulomb=COULOMB)
    return simulate(robot(), motion, seed)


def shards(folder: Path, rows: int, seed: int, shard_rows: int = SHARD_ROWS) -> Iterator[Path]:
    """Write `rows` rows as Parquet, shard by shard; yield the path of each shard."""
    for number, first in enumerate(range(0, rows, shard_rows)):
        path = folder / f"shard-{number:03d}.parquet"
        write(path, stream(min(shard_rows, rows - first), _SEEDS * (seed + 1) + number))
        yield path


def write(path: Path, samples: Samples) -> None:
    """Write samples as Parquet, with a column for each joint and quantity."""
    columns = {"t": samples.t}
    for name in ("q", "dq", "ddq", "tau"):
        for joint, values in enumerate(getattr(samples, name).T, start=1):
            columns[f"{name}{joint}"] = np.ascontiguousarray(values)
    pq.write_table(pa.table(columns), path)
