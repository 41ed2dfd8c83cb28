"""What a model has learnt, as bytes: for snapshots. The version as trained is not part of it."""

from __future__ import annotations

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

from lipcore.compact.statistics import Statistics
from lipcore.model import TorqueModel
from lipcore.online.learner import OnlineModel, Regime
from lipcore.tensors import pack_symmetric, unpack_symmetric

REGIMES = ("now", "before")
ABSENT = float("nan")
"""Stands for None among numbers."""


def dump(online: OnlineModel) -> bytes:
    """Write all but the version as trained; as large however much was learnt."""
    numbers = [ABSENT if each is None else each for each in (online.forgetting_s, online.since, online.reference)]
    tensors = {"numbers": torch.tensor(numbers, dtype=torch.float64), "base": _trained(online.base)}
    for name in REGIMES:
        regime = getattr(online, name)
        if regime is not None:
            tensors |= {f"{name}/{part}": value for part, value in _parts(regime).items()}
    return save_tensors({name: value.clone().contiguous() for name, value in tensors.items()})


def load(base: TorqueModel, payload: bytes) -> OnlineModel:
    """Read what `dump` wrote of the same version; raise ValueError for anything else."""
    try:
        tensors = load_tensors(payload)
        # weights: written by earlier releases; they are solved for, and to the last bit with as many threads only
        same = any(torch.equal(tensors["base"], each) for each in (_trained(base), base.posterior.weights))
        forgetting_s, since, reference = tensors["numbers"].tolist()
        regimes = {name: _regime(tensors, name) for name in REGIMES if f"{name}/numbers" in tensors}
    except (KeyError, SafetensorError, RuntimeError, TypeError) as error:
        raise ValueError(f"these bytes are no state of an online model: {error}") from error
    if not same:
        raise ValueError("the state is of another version")
    size = len(base.posterior.basis)
    for name, regime in regimes.items():
        if regime.centre.shape != (size,) or regime.statistics.a.shape != (size, size):
            raise ValueError(f"{name} has {len(regime.centre)} variables, expected {size}")
    return OnlineModel(base, _number(forgetting_s), _number(since), reference, regimes.get("before"), regimes["now"])


def _trained(base: TorqueModel) -> Tensor:
    """What tells a version from another: read from its files, so that it is the same in every process."""
    statistics = base.posterior.statistics
    return base.posterior.weights if statistics is None else statistics.b


def _parts(regime: Regime) -> dict[str, Tensor]:
    sums = regime.statistics
    numbers = torch.tensor([regime.begins, sums.samples], dtype=torch.float64)
    return {"numbers": numbers, "centre": regime.centre, "a": pack_symmetric(sums.a), "b": sums.b}


def _regime(tensors: dict[str, Tensor], name: str) -> Regime:
    begins, samples = tensors[f"{name}/numbers"].tolist()
    statistics = Statistics(unpack_symmetric(f"{name}/a", tensors[f"{name}/a"]), tensors[f"{name}/b"], samples)
    return Regime(begins, tensors[f"{name}/centre"], statistics)


def _number(value: float) -> float | None:
    return None if value != value else value  # noqa: PLR0124 - NaN alone differs from itself
