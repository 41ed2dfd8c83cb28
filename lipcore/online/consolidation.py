"""What a model has learnt online, made part of the model: so that it can be saved and go to another service."""

from __future__ import annotations

from dataclasses import replace

import torch

from lipcore.compact.posterior import CompactPosterior
from lipcore.compact.statistics import Statistics
from lipcore.model import TorqueModel
from lipcore.online.learner import OnlineModel
from lipcore.samples import Array


def consolidate(online: OnlineModel, floor: Array | None = None) -> TorqueModel:
    """The model that answers as `online.model(floor)` does, to the last bit, and that can be saved.

    The posterior of a regime is that of the sums A and b with the prior N(centre, I): its mean (I + A)⁻¹ (centre + b)
    is also that of the sums A and centre + b with the prior of a trained model, N(0, I). What it no longer holds is
    which part was trained and which learnt: it neither unlearns nor forgets the rows of before.
    """
    base, now = online.base.posterior, online.now
    trained = base.statistics
    # a change of the robot leaves nothing of the training samples but their mean
    samples = online.samples + (trained.samples if trained is not None and online.before is None else 0.0)
    posterior = CompactPosterior.build(
        base.kernel,
        base.basis,
        Statistics(now.statistics.a, now.centre + now.statistics.b, max(samples, 0.0)),
        base.noise_variance,
        base.std_factor,
    )
    if floor is not None:
        posterior = replace(posterior, floor=torch.from_numpy(floor.copy()))
    return replace(online.base, posterior=posterior)
