"""Zero-phase low-pass, acausal differentiation, and the noise level of a signal.

The paper's choices: a 4 Hz cut-off, and no delay. They suit recordings, not live streams.
"""

from __future__ import annotations

from math import comb
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from lipcore.data.samples import Array

CUTOFF = 4.0
"""Default cut-off, Hz."""
ORDER = 4
DIFFERENCE_ORDERS = range(2, 9)


def low_pass(signal: Array, rate: float, cutoff: float = CUTOFF) -> Array:
    """Return the signal after a Butterworth low-pass run forwards and backwards, without phase shift.

    signal: (N, k), evenly sampled at `rate` Hz. Raise ValueError if the cut-off is not below half the rate or the
    signal is too short for the filter.
    """
    from scipy.signal import butter, sosfiltfilt  # noqa: PLC0415 - half a second, for recordings to be filtered only

    if not 0 < cutoff < rate / 2:
        raise ValueError(f"cutoff is {cutoff:g} Hz, expected between 0 and half the sampling rate, {rate / 2:g} Hz")
    sections = butter(ORDER, cutoff, fs=rate, output="sos")
    shortest = 3 * (2 * len(sections) + 1) + 1
    if len(signal) < shortest:
        raise ValueError(f"signal has {len(signal)} samples, expected at least {shortest} to be filtered")
    return np.ascontiguousarray(sosfiltfilt(sections, signal, axis=0), dtype=np.float64)


def differentiate(signal: Array, rate: float) -> Array:
    """Return central differences, one-sided at both ends. signal: (N, k), N ≥ 3, evenly sampled at `rate` Hz."""
    if len(signal) < 3:
        raise ValueError(f"signal has {len(signal)} samples, expected at least 3 to be differentiated")
    return np.asarray(np.gradient(signal, 1.0 / rate, axis=0, edge_order=2), dtype=np.float64)


def noise_level(episodes: list[Array]) -> Array:
    """Return the standard deviation of the white noise on smooth signals, per column.

    A k-th difference cancels what is smooth and keeps noise with the known gain comb(2k, k). The smallest estimate over
    several orders k is the least contaminated by motion. episodes: contiguous signals (N_e, m); returns (m,).
    """
    levels = []
    for order in DIFFERENCE_ORDERS:
        parts = [np.diff(episode, n=order, axis=0) for episode in episodes if len(episode) > order]
        if parts and sum(map(len, parts)) > 2 * order:
            levels.append(np.sqrt(np.mean(np.concatenate(parts) ** 2, axis=0) / comb(2 * order, order)))
    if not levels:
        spread = np.concatenate(episodes).std(axis=0)
        return np.asarray(0.1 * spread)
    return np.asarray(np.min(levels, axis=0))
