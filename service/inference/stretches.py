"""nMSE stretch by stretch: how evenly a model's error is spread over a recording."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from lipcore.data.samples import Array, Samples
from service.inference.schema import Stretches

FEWEST_EPISODES, MOST_EPISODES = 5, 200
"""Episodes stand for stretches where there are so many; fewer make no box plot, more are mostly a few samples long."""
EQUAL = 10


def stretches(samples: Samples, mean: Array) -> Stretches:
    """Mean squared error of each stretch / variance of the measured torque over all samples; mean: (N, n) N·m.

    The variance is that of all samples: a joint that rests for a while has a variance near zero then, and any error
    would look enormous.
    """
    episodes = samples.episodes()
    by_episode = FEWEST_EPISODES <= len(episodes) <= MOST_EPISODES
    if not by_episode:
        edges = np.linspace(0, len(samples), min(EQUAL, len(samples)) + 1).astype(np.int64).tolist()
        episodes = [slice(first, last) for first, last in pairwise(edges)]
    squared = (samples.tau - mean) ** 2
    varies = np.ptp(samples.tau, axis=0) > 0  # rounding gives a constant column a variance above zero
    variance = samples.tau.var(axis=0)
    means = np.array([squared[each].mean(axis=0) for each in episodes])
    return Stretches(
        kind="episodes" if by_episode else "equal",
        samples=[each.stop - each.start for each in episodes],
        nmse=[
            (column / variance[joint]).tolist() if varies[joint] else [None] * len(episodes)
            for joint, column in enumerate(means.T)
        ],
    )
