"""Results as rows, one for each test set and joint, and their summary, for CSV files and figures."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.reproduce.experiment import CellResult
from lipcore.data.metrics import LEVELS
from lipcore.data.samples import Array


class Row(NamedTuple):
    """Figures of one joint on one test set after one training; widths and `torque_std` in N·m."""

    speed: float
    estimator: str
    samples: int
    train_seed: int
    test_seed: int
    joint: str
    nmse: float
    nmse_noisy: float
    coverage_50: float
    coverage_80: float
    coverage_95: float
    coverage_99: float
    width_50: float
    width_80: float
    width_95: float
    width_99: float
    torque_std: float


class Summary(NamedTuple):
    """Figures of one joint over training seeds × test sets: quartiles of the error, mean and lowest coverage."""

    speed: float
    estimator: str
    samples: int
    joint: str
    sets: int
    nmse_q25: float
    nmse_median: float
    nmse_q75: float
    nmse_worst: float
    nmse_noisy_median: float
    coverage_50_mean: float
    coverage_80_mean: float
    coverage_95_mean: float
    coverage_95_lowest: float
    coverage_99_mean: float
    width_95_mean: float


def rows(results: Iterable[CellResult], joint_names: Sequence[str]) -> list[Row]:
    """Return the rows of results without error."""
    assert LEVELS == (0.5, 0.8, 0.95, 0.99)
    found = []
    for result in results:
        cell = result.cell
        for test in result.tests:
            for j, joint in enumerate(joint_names):
                key = (cell.speed, cell.estimator, cell.samples, cell.seed, test.seed, joint)
                levels = [level[j] for level in (*test.coverage, *test.width)]
                found.append(Row._make((*key, test.nmse[j], test.nmse_noisy[j], *levels, test.torque_std[j])))
    return found


def select(table: Iterable[Row], **equal: object) -> list[Row]:
    """Return the rows with the given values in their columns."""
    return [row for row in table if all(getattr(row, name) == value for name, value in equal.items())]


def column(table: Iterable[Row], name: str) -> Array:
    """Return one column of numbers."""
    return np.array([getattr(row, name) for row in table], dtype=np.float64)


def summarise(table: Sequence[Row]) -> list[Summary]:
    """Return the summary of each speed, estimator, number of samples and joint, in the order of their occurrence."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in table:
        groups.setdefault((row.speed, row.estimator, row.samples, row.joint), []).append(row)
    found = []
    for key, group in groups.items():
        nmse, coverage = column(group, "nmse"), column(group, "coverage_95")
        q25, median, q75 = np.percentile(nmse, (25, 50, 75))
        mean = {level: column(group, f"coverage_{level}").mean() for level in (50, 80, 95, 99)}
        figures = (
            *(q25, median, q75, nmse.max(), np.median(column(group, "nmse_noisy"))),
            *(mean[50], mean[80], mean[95], coverage.min(), mean[99]),
            column(group, "width_95").mean(),
        )
        found.append(Summary._make((*key, len(group), *map(float, figures))))
    return found


def write_csv(path: Path, table: Sequence[Row] | Sequence[Summary], kind: type[Row] | type[Summary]) -> None:
    """Write rows with a header, numbers with six digits."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(kind._fields)
        writer.writerows([f"{value:.6g}" if isinstance(value, float) else value for value in row] for row in table)
