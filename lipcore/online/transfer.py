"""Convert what a model has learnt online: to a model to save, to arrays for prediction, to a snapshot."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from lipcore.data.samples import Array
from lipcore.model.torque_model import TorqueModel
from lipcore.online.learner import OnlineModel
from lipcore.online.regime import Epoch, Regime, Walk
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.linalg import pack_symmetric, unpack_symmetric
from lipcore.posterior.statistics import Statistics

REGIMES = ("now", "before")
ABSENT = float("nan")
"""Stands for None among numbers."""


def consolidate(online: OnlineModel, floor: Array | None = None) -> TorqueModel:
    """Return a model that can be saved and predicts as `online.model(floor)` does, to the last bit.

    The posterior of a regime follows from the sums A and b with the prior N(centre, I). Its mean (I + A)⁻¹ (centre + b)
    is also that of the sums A and centre + b with the prior of a trained model, N(0, I). The result no longer separates
    training from learning: it does not forget the rows of before.
    """
    base, now = online.base.posterior, online.now
    trained = base.statistics
    # after a change, only the mean of the training samples remains
    sums = now.sums(online.walk)
    samples = online.samples + (trained.samples if trained is not None and online.before is None else 0.0)
    posterior = CompactPosterior.build(
        base.kernel,
        base.basis,
        Statistics(sums.a, now.centre + sums.b, max(samples, 0.0)),
        base.noise_variance,
        base.std_factor,
        base.misfit,
    )
    if floor is not None:
        posterior = replace(posterior, floor=floor.copy())
    return replace(online.base, posterior=posterior, training_torque=online.training_torque)


@dataclass(frozen=True)
class Revision:
    """Arrays that predict with one basis after some learning."""

    weights: Array
    """Weights of the posterior, (M,)."""
    root: Array
    """Root of the posterior, (M, M), see `CompactPosterior`."""
    packed: Array
    """Both in the layout of the evaluator."""
    floor: Array
    """Min variance of a prediction, (n,) (N·m)²."""
    falls_back: NDArray[np.bool_]
    """Whether predictions may fall back, (1,)."""

    @classmethod
    def of(cls, model: TorqueModel) -> Revision:
        """Return the arrays of a model that has learnt."""
        posterior = model.posterior
        arrays = posterior.weights, posterior.root, model.evaluator.packed, posterior.floor
        falls_back = np.array([model.training_torque is not None])
        weights, root, packed, floor = (np.ascontiguousarray(each) for each in arrays)
        return cls(weights, root, packed, floor, falls_back)

    def apply(self, base: TorqueModel) -> TorqueModel:
        """Return the model of the same basis with these arrays; raise ValueError if shapes do not fit.

        It needs no linear algebra and copies nothing: the arrays may be memory-mapped. They must not change any more.
        """
        for name, like in (("weights", base.posterior.weights), ("root", base.posterior.root)):
            if getattr(self, name).shape != tuple(like.shape):
                raise ValueError(f"{name} has shape {getattr(self, name).shape}, expected {tuple(like.shape)}")
        weights, root, floor = (each for each in (self.weights, self.root, self.floor))
        posterior = replace(base.posterior, weights=weights, root=root, floor=floor, statistics=None)
        falls_back = bool(self.falls_back.all())
        model = replace(base, posterior=posterior, training_torque=base.training_torque if falls_back else None)
        # fill the cached property: the arrays have its layout already
        model.__dict__["evaluator"] = base.evaluator.revised(self.packed, self.floor, falls_back)
        return model


def dump(online: OnlineModel) -> bytes:
    """Return an online model, without the version as trained, as the bytes of a safetensors file.

    Its size does not grow with the rows learnt.
    """
    numbers = [ABSENT if each is None else each for each in (online.forgetting_s, online.since, online.reference)]
    tensors = {"numbers": np.array(numbers), "base": _trained(online.base)}
    if online.walk is not None:
        since = ABSENT if online.walk.since is None else online.walk.since
        tensors["walk"] = np.array([online.walk.time_s, since])
    for name in REGIMES:
        regime = getattr(online, name)
        if regime is not None:
            tensors |= {f"{name}/{part}": value for part, value in _parts(regime).items()}
    return save_tensors({name: np.asarray(value, order="C") for name, value in tensors.items()})


def load(base: TorqueModel, payload: bytes) -> OnlineModel:
    """Return the online model that `dump` wrote. base: the version as trained from which it was started.

    Raise ValueError for bytes that are no such state, or the state of another version.
    """
    try:
        tensors = {name: value.copy() for name, value in load_tensors(payload).items()}
        same = np.array_equal(tensors["base"], _trained(base))
        forgetting_s, since, reference = tensors["numbers"].tolist()
        regimes = {name: _regime(tensors, name) for name in REGIMES if f"{name}/numbers" in tensors}
        walk_s, walk_since = tensors["walk"].tolist() if "walk" in tensors else (ABSENT, ABSENT)
    except (KeyError, SafetensorError, RuntimeError, TypeError, ValueError) as error:
        raise ValueError(f"the bytes are not the state of an online model: {error}") from error
    if not same:
        raise ValueError("the state is of another version")
    size = len(base.posterior.basis)
    for name, regime in regimes.items():
        sums = [regime.statistics, *(each.statistics for each in regime.epochs)]
        if regime.centre.shape != (size,) or any(each.a.shape != (size, size) for each in sums):
            raise ValueError(f"{name} has {len(regime.centre)} variables, expected {size}")
    walk = None if walk_s != walk_s else Walk.of(base, walk_s, _number(walk_since))  # noqa: PLR0124
    return OnlineModel(
        base, _number(forgetting_s), _number(since), reference, regimes.get("before"), regimes["now"], walk
    )


def _trained(base: TorqueModel) -> Array:
    """Return what identifies a version: read from its files, so that it is the same in every process."""
    statistics = base.posterior.statistics
    return base.posterior.weights if statistics is None else statistics.b


def _parts(regime: Regime) -> dict[str, Array]:
    numbers = np.array([regime.begins, regime.statistics.samples, regime.at], np.float64)
    parts = {"numbers": numbers, "centre": regime.centre} | _sums(regime.statistics)
    if regime.epochs:
        every = [[each.number, each.statistics.samples] for each in regime.epochs]
        parts["epochs"] = np.array(every, np.float64)
        for place, each in enumerate(regime.epochs):
            parts |= {f"{place}/{part}": value for part, value in _sums(each.statistics).items()}
    return parts


def _sums(statistics: Statistics) -> dict[str, Array]:
    return {"a": pack_symmetric(statistics.a), "b": statistics.b}


def _regime(tensors: dict[str, Array], name: str) -> Regime:
    begins, samples, at = tensors[f"{name}/numbers"].tolist()
    epochs = tensors[f"{name}/epochs"].tolist() if f"{name}/epochs" in tensors else []
    return Regime(
        begins,
        tensors[f"{name}/centre"],
        _statistics(tensors, name, samples),
        round(at),
        tuple(
            Epoch(round(number), _statistics(tensors, f"{name}/{place}", each))
            for place, (number, each) in enumerate(epochs)
        ),
    )


def _statistics(tensors: dict[str, Array], name: str, samples: float) -> Statistics:
    return Statistics(unpack_symmetric(f"{name}/a", tensors[f"{name}/a"]), tensors[f"{name}/b"], samples)


def _number(value: float) -> float | None:
    return None if value != value else value  # noqa: PLR0124 - NaN alone differs from itself
