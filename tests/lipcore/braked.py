"""Recordings of an arm whose brakes are closed at some rests."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lipcore.data.brakes import BrakedRows
from lipcore.data.samples import Samples


def close_brakes(samples: Samples) -> tuple[Samples, NDArray[np.bool_]]:
    """Return a recording with zero torque at every second rest, and a mask of these rows, (N,)."""
    still = (np.abs(samples.dq) < 1e-6).all(axis=1)
    braked = np.zeros_like(still)
    for first, last in BrakedRows(still).stretches[::2]:
        braked[first : last + 1] = True
    return replace(samples, tau=np.where(braked[:, None], 0.0, samples.tau)), braked
