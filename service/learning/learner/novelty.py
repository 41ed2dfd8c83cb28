"""Which share of what comes lies where a version's basis does not reach."""

from __future__ import annotations

from collections import deque

import numpy as np

from lipcore.online.batch import Rows
from lipcore.online.learner import OnlineModel

STRIDE = 4
"""Every fourth row is looked at: each costs half of what it costs to learn it, and neighbours tell the same."""


class Novelty:
    """Counts rows beyond the basis. window: number of rows that `share` is taken over."""

    def __init__(self, window: int) -> None:
        self._flags: deque[bool] = deque(maxlen=max(1, window // STRIDE))
        self._novel = 0

    def see(self, online: OnlineModel, rows: Rows) -> None:
        """Look at rows that are about to be learnt."""
        chosen = rows.learnt
        chosen = chosen.take(np.arange(0, len(chosen), STRIDE))
        if len(chosen):
            flags = online.novel(chosen).tolist()
            self._flags.extend(flags)
            self._novel += sum(flags)

    @property
    def rows(self) -> int:
        """How many rows lay beyond the basis, of all that came: an estimate."""
        return STRIDE * self._novel

    @property
    def share(self) -> float:
        """Share of the last rows that do; 0 before there are enough to fill the window."""
        full = len(self._flags) == self._flags.maxlen
        return sum(self._flags) / len(self._flags) if full else 0.0
