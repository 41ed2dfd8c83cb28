"""What a recording holds before it is checked: columns as they were uploaded."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lipcore.samples import Array
from service.errors import InvalidDataError, invalid_data

QUANTITIES = ("q", "dq", "ddq", "tau")
JOINT_COLUMN = re.compile(r"(q|dq|ddq|tau)([1-9][0-9]{0,3})")
KNOWN = "t, q1..qn, dq1..dqn, ddq1..ddqn, tau1..taun or episode"


@dataclass(frozen=True)
class Columns:
    """Uploaded columns: q and tau (N, n); dq, ddq, t (N,) and episode (N,) where given; joint names where given."""

    q: Array
    tau: Array
    dq: Array | None = None
    ddq: Array | None = None
    t: Array | None = None
    episode: NDArray[np.int64] | None = None
    joint_names: tuple[str, ...] | None = None


def order_columns(names: Sequence[str]) -> dict[str, list[int]]:
    """Map t, episode and each quantity to the indices of its columns, joint 1 first.

    Raise InvalidDataError naming the column that is unknown, doubled or missing.
    """
    found: dict[str, int] = {}
    for index, name in enumerate(names):
        if name not in ("t", "episode") and not JOINT_COLUMN.fullmatch(name):
            raise invalid_data(f"column {index + 1}", name, f"one of {KNOWN}")
        if name in found:
            raise invalid_data(f"column {index + 1}", name, "every column once")
        found[name] = index
    n = max((int(m[2]) for name in names if (m := JOINT_COLUMN.fullmatch(name)) and m[1] == "q"), default=0)
    if n == 0:
        raise invalid_data("columns", ", ".join(names), "positions q1..qn")
    order: dict[str, list[int]] = {name: [found[name]] for name in ("t", "episode") if name in found}
    for quantity in QUANTITIES:
        wanted = [f"{quantity}{joint}" for joint in range(1, n + 1)]
        given = [name for name in found if (m := JOINT_COLUMN.fullmatch(name)) and m[1] == quantity]
        if not given and quantity in ("dq", "ddq"):
            continue
        for name in wanted:
            if name not in found:
                raise invalid_data(f"column {name}", "missing", f"{quantity}1..{quantity}{n}, as there are q1..q{n}")
        for name in given:
            if name not in wanted:
                raise invalid_data(f"column {name}", "present", f"at most {quantity}{n}, as there are q1..q{n}")
        order[quantity] = [found[name] for name in wanted]
    return order


def whole_numbers(values: Array) -> NDArray[np.int64]:
    """Episode numbers as integers; raise InvalidDataError where one is not whole."""
    wrong = np.flatnonzero(~np.isfinite(values) | (values != np.floor(values)) | (np.abs(values) > 2**53))
    if len(wrong):
        raise invalid_data(f"episode, row {wrong[0] + 1}", float(values[wrong[0]]), "a whole number")
    return values.astype(np.int64)


def too_many(rows: int, limit: int) -> InvalidDataError:
    """Error for a data set of more rows than the limit."""
    return invalid_data("rows", rows, f"at most {limit} samples")
