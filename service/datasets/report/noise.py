"""White noise of one column of a recording that has many parts: as `data.signals.noise_level` has it, in one go."""

from __future__ import annotations

from math import comb

import numpy as np

from lipcore.data.samples import Array
from lipcore.data.signals import DIFFERENCE_ORDERS
from service.datasets.report.parts import Rows

NORMAL = 1.4826
"""Standard deviation of normal noise over the median of its size."""
MOST = 200_000
"""Differences that are enough for a median."""
SPREAD_SHARE = 0.1
"""Of the spread: what stands in where the parts are too short to tell, as in `noise_level`."""


def white_noise(values: Array, part: Rows, robust: bool = False) -> float | None:
    """Standard deviation of the white noise on smooth signals; None where the parts are too short to tell.

    values: (N,), missing ones NaN; part: number of the part of each row, ascending, (N,). A missing value has to be a
    part of its own. robust: by the median of the differences, so that jumps, as of Coulomb friction, count for nothing.
    """
    levels: list[float] = []
    difference = values
    for order in range(1, DIFFERENCE_ORDERS.stop):
        difference = np.diff(difference)
        if order not in DIFFERENCE_ORDERS or len(difference) == 0:
            continue
        within = difference[part[order:] == part[:-order]]
        if len(within) > 2 * order:
            levels.append(_size(within, robust) / comb(2 * order, order) ** 0.5)
    return min(levels) if levels else None


def _size(differences: Array, robust: bool) -> float:
    """Their root mean square, or what it would be by their median; coarse signals mostly have none that is not 0."""
    if robust:
        some = differences[:: max(1, len(differences) // MOST)]
        middle = NORMAL * float(np.median(np.abs(some)))
        if middle > 0:
            return middle
    return float(np.sqrt(np.dot(differences, differences) / len(differences)))


def noise_or_share(values: Array, part: Rows) -> float:
    """The same, a tenth of the spread where the parts are too short: equal to `noise_level`."""
    level = white_noise(values, part)
    return SPREAD_SHARE * float(values.std()) if level is None else level
