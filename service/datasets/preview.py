"""A recording thinned for a plot: of every stretch of rows the smallest and the largest value of each column."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field
from safetensors import safe_open

from lipcore.data.samples import Array

MOST_POINTS = 2000
"""Most points of a column."""
MOST_STARTS = 2000
UNITS = {"q": "rad or m", "dq": "rad/s or m/s", "ddq": "rad/s² or m/s²", "tau": "N·m or N"}

ReadRows = Callable[[str, int, int], Array]
"""(quantity, first row, row after the last) → these rows of all joints, (rows, n)."""


class PreviewColumn(BaseModel):
    """Points of one quantity of one joint, in order of rows."""

    quantity: str = Field(description="q, dq, ddq or tau")
    joint: str
    unit: str
    rows: list[int] = Field(description="Rows that the points are, counted from 0")
    t: list[float] = Field(description="Their times, s")
    values: list[float]


class Preview(BaseModel):
    """Columns of a data set, thinned so that no extreme is lost."""

    samples: int = Field(description="Rows of the data set")
    starts: list[int] = Field(
        description=f"First rows of the episodes, for breaks in the lines; at most {MOST_STARTS}, evenly chosen"
    )
    columns: list[PreviewColumn]


def make_preview(
    t: Array,
    episode: NDArray[np.int64] | Array,
    joint_names: Sequence[str],
    quantities: Sequence[str],
    read: ReadRows,
    points: int = MOST_POINTS,
) -> Preview:
    """Thin the quantities of all joints to at most `points` points a column, at least 2; t, episode: (N,)."""
    starts = np.concatenate([[0], np.flatnonzero(np.diff(episode)) + 1])
    if len(starts) > MOST_STARTS:
        starts = starts[np.linspace(0, len(starts) - 1, MOST_STARTS).astype(np.int64)]
    columns = []
    for quantity in quantities:
        for name, (rows, values) in zip(joint_names, extremes(len(t), quantity, read, points), strict=True):
            columns.append(
                PreviewColumn(
                    quantity=quantity,
                    joint=name,
                    unit=UNITS[quantity],
                    rows=rows.tolist(),
                    t=t[rows].tolist(),
                    values=values.tolist(),
                )
            )
    return Preview(samples=len(t), starts=starts.tolist(), columns=columns)


def extremes(count: int, quantity: str, read: ReadRows, points: int) -> list[tuple[NDArray[np.int64], Array]]:
    """For each joint ascending rows, at most `points`, and their values: all, or the extremes of stretches."""
    if points < 2:
        raise ValueError(f"points is {points}, expected at least 2")
    if count <= points:
        every_row = read(quantity, 0, count)
        return [(np.arange(count, dtype=np.int64), column) for column in every_row.T]
    rows, values = [], []
    for first, last in pairwise(np.linspace(0, count, points // 2 + 1).astype(np.int64).tolist()):
        stretch = read(quantity, first, last)
        both = np.sort([stretch.argmin(axis=0), stretch.argmax(axis=0)], axis=0)
        rows.append(first + both)
        values.append(np.take_along_axis(stretch, both, axis=0))
    at, what = np.concatenate(rows).T, np.concatenate(values).T
    # a stretch whose smallest value is its largest gives one point
    new = [np.concatenate([[True], np.diff(each) > 0]) for each in at]
    return [(a[keep].astype(np.int64), b[keep]) for a, b, keep in zip(at, what, new, strict=True)]


def preview_file(path: Path, joint_names: Sequence[str], quantities: Sequence[str], points: int) -> Preview:
    """Preview of stored samples, see sample_file.py; no more than the times and a stretch of rows are held."""
    with safe_open(path, framework="numpy") as file:
        slices = {quantity: file.get_slice(quantity) for quantity in quantities}
        return make_preview(
            file.get_tensor("t"),
            file.get_tensor("episode"),
            joint_names,
            quantities,
            lambda quantity, first, last: np.asarray(slices[quantity][first:last]),
            points,
        )
