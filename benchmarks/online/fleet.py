"""Robots of one kind that learn apart and put together what they have learnt."""

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
    """How far the posterior from merged statistics lies from that of all samples at once.

    The largest difference of mean torque and of its standard deviation at the queries, relative to the largest torque.
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
