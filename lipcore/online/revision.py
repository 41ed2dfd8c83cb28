"""What changes of a served model when it learns: a few arrays, cheap to hand to another process."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from lipcore.model import TorqueModel
from lipcore.samples import Array


@dataclass(frozen=True)
class Revision:
    """Answers of one basis after some learning.

    weights: (M,); root: (M, M), see `CompactPosterior`; packed: both as the evaluator lays them out; floor: (n,).
    """

    weights: Array
    root: Array
    packed: Array
    floor: Array

    @classmethod
    def of(cls, model: TorqueModel) -> Revision:
        """The arrays of a model that has learnt."""
        posterior = model.posterior
        arrays = posterior.weights.numpy(), posterior.root.numpy(), model.evaluator.packed, posterior.floor.numpy()
        return cls(*(np.ascontiguousarray(each) for each in arrays))

    def apply(self, base: TorqueModel) -> TorqueModel:
        """Return the model of the same basis that answers so; raise ValueError where shapes do not fit.

        No linear algebra, and nothing is copied: the arrays may be memory-mapped, copy-on-write because torch takes
        writable memory only. They must not change any more.
        """
        for name, like in (("weights", base.posterior.weights), ("root", base.posterior.root)):
            if getattr(self, name).shape != tuple(like.shape):
                raise ValueError(f"{name} has shape {getattr(self, name).shape}, expected {tuple(like.shape)}")
        weights, root, floor = (torch.from_numpy(each) for each in (self.weights, self.root, self.floor))
        posterior = replace(base.posterior, weights=weights, root=root, floor=floor, statistics=None)
        model = replace(base, posterior=posterior)
        # the cached property, filled without laying anything out again
        model.__dict__["evaluator"] = base.evaluator.revised(self.packed, self.floor)
        return model
