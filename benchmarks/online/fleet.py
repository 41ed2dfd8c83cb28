"""Merging of the statistics of several robots of one kind."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import numpy as np

from lipcore.data.motion import Array, Motion
from lipcore.data.samples import Samples
from lipcore.model.torque_model import TorqueModel
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.statistics import Statistics, collect, merge


def merged_difference(model: TorqueModel, parts: Sequence[Samples], queries: Motion) -> float:
    """Return the relative difference between posteriors of merged statistics and of all samples at once.

    It is the largest difference of torque or standard deviation at the queries, over the largest torque.
    """
    posterior = model.posterior
    kernel, noise = posterior.kernel, posterior.noise_variance

    def collected(samples: Samples) -> Statistics:
        motion = samples.motion()
        return collect(posterior.basis, noise, motion, samples.tau - kernel.mean(motion))

    def answers(statistics: Statistics) -> tuple[Array, Array]:
        built = CompactPosterior.build(kernel, posterior.basis, statistics, noise, posterior.std_factor)
        found = built.predict(queries)
        return found.mean, found.std

    apart = answers(reduce(merge, map(collected, parts)))
    together = answers(collected(Samples.concatenate(list(parts))))
    largest = max(float(np.abs(one - other).max()) for one, other in zip(apart, together, strict=True))
    return largest / float(np.abs(together[0]).max())
