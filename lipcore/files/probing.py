"""Test predictions of a model from an untrusted source, before it is used."""

from __future__ import annotations

import numpy as np

from lipcore.data.samples import Array
from lipcore.files.entries import MAX_VALUE
from lipcore.files.manifest import TENSORS, ModelFormatError
from lipcore.model.torque_model import TorqueModel


def probe(model: TorqueModel) -> None:
    """Test a model's predictions inside and outside its data; raise ModelFormatError for an invalid one.

    The motions are rest, the ends and the middle of its training range, and some of its inducing samples. Each is
    predicted in both ways: as a batch and as a single query.
    """
    motion = _motions(model)
    with np.errstate(all="ignore"):  # overflows show in the predictions
        answer = model.predict(motion[0], motion[1], motion[2], covariance=True)
        single = [model.answer(np.ascontiguousarray(motion[:, row])) for row in range(motion.shape[1])]
    torques = ("tau", "tau of a single query")
    parts = {
        "tau": answer.tau,
        "tau_std": answer.tau_std,
        "noise_std": answer.noise_std,
        "covariance": answer.covariance,
        "tau of a single query": np.array([tau for tau, _ in single]),
        "tau_std of a single query": np.array([std for _, std in single], dtype=np.float64),
    }
    for name, values in parts.items():
        if values is None or not np.isfinite(values).all():
            raise ModelFormatError(f"{name} of a probe is not finite", TENSORS)
        if name in torques and np.abs(values).max() > MAX_VALUE:  # its standard deviation has no limit
            raise ModelFormatError(f"{name} of a probe is beyond ±{MAX_VALUE:g}", TENSORS)
        if "std" in name and (values < 0).any():
            raise ModelFormatError(f"{name} of a probe is below zero", TENSORS)


def _motions(model: TorqueModel) -> Array:
    """Return the motions to predict, (3, K, n)."""
    ranges = [model.training_range[name] for name in ("q", "dq", "ddq")]
    low, high = (np.array([each[end] for each in ranges]) for end in ("min", "max"))
    inducing = model.posterior.basis.inducing
    # at inducing samples its predictions are furthest from the prior's
    seen = np.stack([part[:20] for part in (inducing.q, inducing.dq, inducing.ddq)])
    fixed = np.stack([np.zeros_like(low), low, high, 0.5 * (low + high)], axis=1)
    return np.concatenate([fixed, seen], axis=1)
