"""What is low-passed and derived at a rate, and doing so without delay."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from lipcore.data.samples import Array
from lipcore.data.signals import ORDER, differentiate
from lipcore.preparation.recipe import Form, PreparationError, Recipe
from lipcore.preparation.resampling import BLOCK, SAME_RATE

QUANTITIES = ("q", "dq", "ddq", "tau")
Read = Callable[[str], Array]
"""A quantity → its column, read when it is asked for: no more than one has to be in memory."""
SHORTEST = 3 * (2 * ((ORDER + 1) // 2) + 1) + 1
"""Fewest samples that can be low-passed."""
SETTLED = 2.0
"""Periods of the cut-off that a causal filter needs to forget how a part began.

Measured on arms that move from the start, at up to 1.6 Hz, filtered at 4 Hz: within the first period accelerations are
off by 80 %, within the second by 11 %, within the third by 2.5 % and from then on by 2.2 %.
"""


@dataclass(frozen=True)
class Filters:
    """What a recipe comes to at a rate.

    rate: Hz, of what is worked on; derived: of dq, ddq; cutoff: Hz of the low-pass, None where there is none;
    low_passed: the quantities it is used on; every: samples at `rate` for one that comes out; edges: samples cut off at
    the start and at the end of every part; form: as in the recipe.
    """

    rate: float
    given: tuple[str, ...]
    derived: tuple[str, ...]
    cutoff: float | None
    low_passed: tuple[str, ...]
    every: float
    edges: tuple[int, int]
    form: Form

    @property
    def shortest(self) -> int:
        """Fewest samples of a part that something comes out of."""
        least = SHORTEST if self.cutoff is not None else 3 if self.derived else 1
        return max(least, sum(self.edges) + 1)

    @property
    def needs_even_steps(self) -> bool:
        """Whether samples have to be evenly spaced."""
        return bool(self.derived) or self.cutoff is not None


def derived(given: tuple[str, ...]) -> tuple[str, ...]:
    """Of dq and ddq, what is to be derived; raise PreparationError where q or tau is missing."""
    for name in ("q", "tau"):
        if name not in given:
            raise PreparationError(name, "missing", "columns of it, as nothing else tells")
    return tuple(name for name in ("dq", "ddq") if name not in given)


def filters(given: tuple[str, ...], recipe: Recipe) -> bool:
    """Whether the recipe low-passes a recording of these quantities."""
    return recipe.filtering == "always" or (recipe.filtering == "derived" and bool(derived(given)))


def settle(rate: float, given: tuple[str, ...], recipe: Recipe) -> Filters:
    """What the recipe comes to on signals at `rate` Hz; raise PreparationError where that is impossible.

    What is thinned is low-passed before, at 0.4 times the new rate where nothing lower is asked for: then all of it,
    and otherwise recorded accelerations only where all is to be filtered or samples are late.
    """
    missing = derived(given)
    asked_rate = recipe.rate_hz
    if asked_rate is not None and asked_rate > rate * (1 + SAME_RATE):
        raise PreparationError("rate", f"{asked_rate:g} Hz", f"at most the recording's, {rate:g} Hz")
    thins = asked_rate is not None and asked_rate < rate * (1 - SAME_RATE)
    filtered = filters(given, recipe)
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
    if recipe.form == "causal":  # it never sees the end
        return int(np.ceil(SETTLED * rate / cutoff)), 0
    edge = int(np.ceil(rate / cutoff))
    return edge, edge


class ZeroPhase:
    """`data.signals.low_pass` for one column after the other: designed once, and holding one copy of a column."""

    def __init__(self, rate: float, cutoff: float) -> None:
        from scipy.signal import butter, sosfilt, sosfilt_zi  # noqa: PLC0415 - half a second

        self._sosfilt = sosfilt
        self._sections = butter(ORDER, cutoff, fs=rate, output="sos")
        self._at_rest = sosfilt_zi(self._sections)

    def __call__(self, signal: Array) -> Array:
        """Low-pass (N,), N ≥ SHORTEST; beyond its ends it goes on as it came, turned by half a turn."""
        edge = SHORTEST - 1
        before, after = 2 * signal[0] - signal[edge:0:-1], 2 * signal[-1] - signal[-2 : -edge - 2 : -1]
        smooth = np.concatenate([before, signal, after])
        for direction in (smooth, smooth[::-1]):
            state = self._at_rest * direction[0]
            for begin in range(0, len(direction), BLOCK):
                block = slice(begin, begin + BLOCK)
                direction[block], state = self._sosfilt(self._sections, direction[block], zi=state)
        return np.asarray(smooth[edge:-edge])


def without_delay(read: Read, work: Filters, low_pass: ZeroPhase | None) -> Iterator[tuple[str, Array]]:
    """q, dq, ddq, tau, in turn, of one contiguous part: `read` gives columns (N,), evenly sampled, N ≥ work.shortest.

    As in the paper: a Butterworth filter run forwards and backwards, central differences, and dq filtered once more
    before it is differentiated. low_pass: with work's rate and cut-off, None where there is none.
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
