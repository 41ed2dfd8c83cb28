"""The filters of a recipe at a sampling rate, and their application without delay."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from lipcore.data.samples import Array
from lipcore.data.signals import ORDER, differentiate
from lipcore.preparation.recipe import Form, PreparationError, Recipe
from lipcore.preparation.resampling import BLOCK_ROWS, RATE_TOLERANCE

QUANTITIES = ("q", "dq", "ddq", "tau")
QuantityReader = Callable[[str], Array]
"""Returns the column of a quantity when it is needed, so that only one has to be in memory."""
MIN_SAMPLES = 3 * (2 * ((ORDER + 1) // 2) + 1) + 1
"""Min samples that can be low-passed."""
SETTLING_PERIODS = 2.0
"""Periods of the cut-off until a causal filter has forgotten how a part began.

Measured on arms that move from the start, at up to 1.6 Hz, filtered at 4 Hz: within the first period accelerations are
off by 80 %, within the second by 11 %, within the third by 2.5 % and from then on by 2.2 %.
"""


@dataclass(frozen=True)
class Filters:
    """The filters of a recipe at a sampling rate."""

    rate: float
    """Sampling rate of the filters, Hz."""
    given: tuple[str, ...]
    """Recorded quantities."""
    derived: tuple[str, ...]
    """Those of dq, ddq that are derived."""
    cutoff: float | None
    """Cut-off of the low-pass, Hz, None without one."""
    low_passed: tuple[str, ...]
    """Quantities that are low-passed."""
    every: float
    """Samples at `rate` per sample that is returned."""
    edges: tuple[int, int]
    """Samples cut off at the start and at the end of every part."""
    form: Form

    @property
    def shortest(self) -> int:
        """Return the min length of a part, in samples. Of a shorter part, no sample remains."""
        least = MIN_SAMPLES if self.cutoff is not None else 3 if self.derived else 1
        return max(least, sum(self.edges) + 1)

    @property
    def needs_even_steps(self) -> bool:
        """Return whether samples have to be evenly spaced."""
        return bool(self.derived) or self.cutoff is not None


def list_derived(given: tuple[str, ...]) -> tuple[str, ...]:
    """Return those of dq and ddq that must be derived; raise PreparationError if q or tau is missing."""
    for name in ("q", "tau"):
        if name not in given:
            raise PreparationError(name, "missing", "columns for it, as it cannot be derived")
    return tuple(name for name in ("dq", "ddq") if name not in given)


def should_low_pass(given: tuple[str, ...], recipe: Recipe) -> bool:
    """Return whether the recipe low-passes a recording of these quantities."""
    return recipe.filtering == "always" or (recipe.filtering == "derived" and bool(list_derived(given)))


def resolve_filters(rate: float, given: tuple[str, ...], recipe: Recipe) -> Filters:
    """Return the filters of the recipe at `rate` Hz; raise PreparationError if they are impossible.

    Thinned signals are low-passed first, at 0.4 times the new rate unless a lower cut-off is requested. This low-pass
    applies to all quantities. Otherwise recorded accelerations are low-passed only if the recipe filters always or is
    causal.
    """
    missing = list_derived(given)
    asked_rate = recipe.rate_hz
    if asked_rate is not None and asked_rate > rate * (1 + RATE_TOLERANCE):
        raise PreparationError("rate", f"{asked_rate:g} Hz", f"at most the recording's rate, {rate:g} Hz")
    thins = asked_rate is not None and asked_rate < rate * (1 - RATE_TOLERANCE)
    filtered = should_low_pass(given, recipe)
    cutoff = recipe.cutoff_hz if filtered else None
    if cutoff is not None and cutoff >= rate / 2 * (1 - 1e-6):  # a rate read off times is never exact
        raise PreparationError("cutoff", f"{cutoff:g} Hz", f"less than half the rate of {rate:g} Hz")
    if thins and asked_rate is not None:
        cutoff = min(cutoff or np.inf, 0.4 * asked_rate)
    everything = thins or recipe.filtering == "always" or recipe.form == "causal"
    low_passed = tuple(name for name in ("q", "tau", "dq", "ddq") if name in given and (name != "ddq" or everything))
    return Filters(
        rate,
        given,
        missing,
        cutoff,
        () if cutoff is None else low_passed,
        rate / asked_rate if thins and asked_rate is not None else 1.0,
        _edges(rate, cutoff, recipe),
        recipe.form,
    )


def _edges(rate: float, cutoff: float | None, recipe: Recipe) -> tuple[int, int]:
    if recipe.trim_s is not None:
        edge = int(np.ceil(recipe.trim_s * rate - 1e-9))
        return edge, edge
    if cutoff is None:
        return 0, 0
    if recipe.form == "causal":  # its end is unspoilt
        return int(np.ceil(SETTLING_PERIODS * rate / cutoff)), 0
    edge = int(np.ceil(rate / cutoff))
    return edge, edge


class ZeroPhase:
    """The low-pass of `lipcore.data.signals.low_pass` for one column at a time, with one copy of a column in memory."""

    def __init__(self, rate: float, cutoff: float) -> None:
        from scipy.signal import butter, sosfilt, sosfilt_zi  # noqa: PLC0415 - half a second

        self._sosfilt = sosfilt
        self._sections = butter(ORDER, cutoff, fs=rate, output="sos")
        self._at_rest = sosfilt_zi(self._sections)

    def __call__(self, signal: Array) -> Array:
        """Return the low-passed signal (N,), N ≥ MIN_SAMPLES; it is extended beyond its ends by point reflection."""
        edge = MIN_SAMPLES - 1
        before, after = 2 * signal[0] - signal[edge:0:-1], 2 * signal[-1] - signal[-2 : -edge - 2 : -1]
        smooth = np.concatenate([before, signal, after])
        for direction in (smooth, smooth[::-1]):
            state = self._at_rest * direction[0]
            for begin in range(0, len(direction), BLOCK_ROWS):
                block = slice(begin, begin + BLOCK_ROWS)
                direction[block], state = self._sosfilt(self._sections, direction[block], zi=state)
        return np.asarray(smooth[edge:-edge])


def without_delay(read: QuantityReader, work: Filters, low_pass: ZeroPhase | None) -> Iterator[tuple[str, Array]]:
    """Yield q, dq, ddq, tau, in turn, of one contiguous part, filtered without delay.

    As in the paper: a Butterworth filter run forwards and backwards, central differences, and dq filtered once more
    before it is differentiated. read: returns columns (N,), evenly sampled, N ≥ work.shortest; low_pass: for the rate
    and cut-off of `work`, None without a low-pass.
    """

    def filtered(name: str) -> Array:
        return read(name) if low_pass is None or name not in work.low_passed else low_pass(read(name))

    q = filtered("q")
    yield "q", q
    dq = differentiate(q, work.rate) if "dq" in work.derived else filtered("dq")
    del q  # a column may be 8 MB
    yield "dq", dq
    if "ddq" not in work.derived:
        yield "ddq", filtered("ddq")
    else:
        smooth = dq if low_pass is None else low_pass(dq)
        del dq
        yield "ddq", differentiate(smooth, work.rate)
        del smooth
    yield "tau", filtered("tau")
