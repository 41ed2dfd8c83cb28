"""How long a fit will still take: extrapolated from the pace of its search."""

from __future__ import annotations

from lipcore.fitting.hyperparameters import FitProgress

SEARCH = "hyperparameters"
LEAST_FRACTION = 0.05
"""Share of several fits after which their pace says something."""
LEAST_ITERATIONS = 3
"""Iterations after which their pace says something."""
POSTERIOR_ITERATIONS = 1.5
"""Iterations of the search that conditioning, compressing and saving take as long as, where both stand on equally many
samples. Both grow with the cube of theirs: measured 0.9 for two joints and 1.9 for seven."""


class Remaining:
    """Fed with a fit's progress, it tells roughly the seconds that are left, None until they can be told.

    searched, conditioned: samples of the search and of the posterior. The search is taken to need all of its
    iterations; it often converges earlier.
    """

    def __init__(self, searched: int, conditioned: int) -> None:
        self._after_search = max(1.0, POSTERIOR_ITERATIONS * (conditioned / searched) ** 3)
        self._first: tuple[float, int] | None = None
        self._pace: float | None = None
        self._ends: float | None = None

    def step(self, at: FitProgress, clock: float) -> None:
        """Take a step of the fit. clock: monotonic time, s."""
        if at.estimator is not None:  # one of several: how long each takes shows in the share of all that is done
            if at.fraction >= LEAST_FRACTION:
                self._ends = clock + at.elapsed * (1 - at.fraction) / at.fraction
            return
        if at.stage == SEARCH:
            if self._first is None:
                self._first = (clock, at.iteration)
            elif at.iteration >= LEAST_ITERATIONS:
                began, before = self._first
                self._pace = (clock - began) / (at.iteration - before)
        if self._pace is not None:
            left = at.max_iterations - at.iteration if at.stage == SEARCH else 0
            self._ends = clock + self._pace * (left + self._after_search)

    def seconds(self, clock: float) -> float | None:
        """Seconds that are left at a monotonic time, None where that cannot be told, or was told too low."""
        if self._ends is None or clock >= self._ends:
            return None
        return self._ends - clock
