"""What makes a recording usable; each rule says what is wrong and where."""

from __future__ import annotations

import numpy as np

from service.datasets.columns import Columns
from service.errors import invalid_data
from service.settings import Settings

CONSTANT = 1e-6
"""A joint whose positions span less than this (rad, m) has not moved."""
LARGEST = 1e12
"""No time, motion or torque in SI units is larger; beyond it, squares and differences overflow."""
MAX_NAME = 100


def check(columns: Columns, settings: Settings) -> None:
    """Raise InvalidDataError for the first thing that makes the recording unusable."""
    rows, n = columns.q.shape
    if not 1 <= n <= settings.max_joints:
        raise invalid_data("joints", n, f"1 to {settings.max_joints}")
    if rows < settings.min_samples:
        raise invalid_data("rows", rows, f"at least {settings.min_samples} samples")
    _check_numbers(columns)
    _check_time(columns)
    farthest = np.unravel_index(np.abs(columns.q).argmax(), columns.q.shape)
    if abs(columns.q[farthest]) > settings.max_position:
        raise invalid_data(
            f"q{farthest[1] + 1}, row {farthest[0] + 1}",
            f"{columns.q[farthest]:g}",
            f"radians (or metres) within ±{settings.max_position:g}: are these degrees?",
        )
    for joint, span in enumerate(np.ptp(columns.q, axis=0)):
        if span < CONSTANT:
            raise invalid_data(
                f"q{joint + 1}", f"constant at {columns.q[0, joint]:g}", "a joint that moves: leave out locked joints"
            )


def check_names(names: tuple[str, ...], n: int) -> None:
    """Raise InvalidDataError unless there are n distinct printable joint names."""
    if len(names) != n:
        raise invalid_data("joint_names", f"{len(names)} names", f"{n} names, one a joint")
    for index, name in enumerate(names):
        if not name or len(name) > MAX_NAME or not name.isprintable():
            raise invalid_data(f"joint_names[{index}]", name, f"1 to {MAX_NAME} printable characters")
        if name in names[:index]:
            raise invalid_data(f"joint_names[{index}]", name, "names that differ")


def _check_numbers(columns: Columns) -> None:
    for name in ("t", "q", "dq", "ddq", "tau"):
        values = getattr(columns, name)
        if values is None or (usable := np.abs(values) <= LARGEST).all():
            continue
        where = np.argwhere(~usable)[0]
        column = f"{name}{where[1] + 1}" if values.ndim == 2 else name
        value = values[tuple(where)]
        expected = f"SI units, within ±{LARGEST:g}" if np.isfinite(value) else "a finite number"
        raise invalid_data(f"{column}, row {where[0] + 1}", str(value), expected)


def _check_time(columns: Columns) -> None:
    if columns.t is None:
        return
    step = np.diff(columns.t)
    within = np.ones(len(step), dtype=bool) if columns.episode is None else np.diff(columns.episode) == 0
    backwards = np.flatnonzero(within & (step <= 0))
    if len(backwards):
        row = int(backwards[0]) + 1
        raise invalid_data(
            f"t, row {row + 1}", f"{columns.t[row]:g}", f"more than {columns.t[row - 1]:g}, the time before it"
        )
