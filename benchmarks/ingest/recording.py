"""Simulated recordings of any length, written block by block with pyarrow."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq

from lipcore.data.samples import Array

RATE = 1000.0
BLOCK = 50_000
FORMATS = ("parquet", "csv")
SINUSOIDS = 5
NOISE = 0.05


def write(path: Path, rows: int, n_joints: int, columns: tuple[str, ...], seed: int) -> None:
    """Write t and the given columns at RATE, as Parquet or CSV by the suffix of the path."""
    names = ["t", *(f"{name}{joint}" for name in columns for joint in range(1, n_joints + 1))]
    schema = pa.schema([(name, pa.float64()) for name in names])
    with pq.ParquetWriter(path, schema) if path.suffix == ".parquet" else pa_csv.CSVWriter(path, schema) as writer:
        for block in _blocks(rows, n_joints, columns, seed):
            writer.write_table(pa.table(dict(zip(names, block.T, strict=True)), schema=schema))


def _blocks(rows: int, n_joints: int, columns: tuple[str, ...], seed: int) -> Iterator[Array]:
    """Yield sinusoids of 0.1 to 1 Hz, with the torque of independent pendulums, friction and white noise."""
    rng = np.random.default_rng(seed)
    omega = 2 * np.pi * rng.uniform(0.1, 1.0, (SINUSOIDS, n_joints))
    phase = rng.uniform(0, 2 * np.pi, (SINUSOIDS, n_joints))
    for start in range(0, rows, BLOCK):
        t = np.arange(start, min(start + BLOCK, rows)) / RATE
        angle = t[:, None, None] * omega + phase
        found = {
            "q": 0.3 * np.sin(angle).sum(axis=1),
            "dq": 0.3 * (omega * np.cos(angle)).sum(axis=1),
            "ddq": -0.3 * (omega**2 * np.sin(angle)).sum(axis=1),
        }
        friction = 0.3 * np.sign(found["dq"]) + 0.5 * found["dq"]
        noise = NOISE * rng.standard_normal(friction.shape)
        found["tau"] = found["ddq"] + 5 * np.sin(found["q"]) + friction + noise
        yield np.column_stack([t, *(found[name] for name in columns)])
