"""Tensors that a model can answer, and computing those that are asked for."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from lipcore.data.motion import Motion
from lipcore.model import dynamics
from lipcore.model.dynamics import available
from lipcore.model.torque_model import TorqueModel
from lipcore.vocabulary import COMPONENTS, ComponentName
from service.foundation.errors import invalid_request

Array = NDArray[np.float64]
Shape = tuple[int, ...]

DEFAULT = ("tau", "tau_std")
QUICK = frozenset({"tau", "tau_std", "noise_std"})
"""Outputs of which one query is answered on the event loop."""
FORWARD: ComponentName = "forward_dynamics"
_STD = "_std"
_TORQUES = ("gravity", "coriolis", "inertial", "friction")


class Part(NamedTuple):
    """A component as a tensor: its mean, or its standard deviation."""

    component: ComponentName
    std: bool


PARTS: dict[str, Part] = {
    (f"tau_{name}" if name in _TORQUES else name) + suffix: Part(name, bool(suffix))
    for name in COMPONENTS
    for suffix in ("", _STD)
}
"""Tensors of components by name; components that are torques begin with `tau_`."""
NEED_TORQUE = frozenset(name for name, part in PARTS.items() if part.component == FORWARD)


def shapes(model: TorqueModel) -> dict[str, Shape]:
    """Every tensor that a model can answer, and its shape at N queries; -1 stands for N."""
    n, offered = model.n_joints, available(model.estimator)
    found: dict[str, Shape] = {"tau": (-1, n), "tau_std": (-1, n), "noise_std": (n,), "covariance": (-1, n, n)}
    for name, part in PARTS.items():
        if part.component in offered:
            found[name] = _shape(part.component, n)
    return found


def _shape(component: ComponentName, n: int) -> Shape:
    if component == "inertia_matrix":
        return (-1, n, n)
    # an energy is a tensor of one number a query: not every client takes a tensor without axes
    return (-1, 1) if component in ("kinetic_energy", "potential_energy") else (-1, n)


def compute(model: TorqueModel, motion: Array, names: frozenset[str], tau: Array | None) -> dict[str, Array]:
    """Tensors by name, their first axis N, noise_std (n,) apart; nothing is computed that they do not need.

    motion: q, dq and ddq, (3, N, n); tau: (N, n) N·m, for forward dynamics. Raise InvalidRequestError where inertia
    cannot be inverted.
    """
    found = _torques(model, motion, names)
    if "noise_std" in names:
        found["noise_std"] = model.noise_std
    parts = {name: PARTS[name] for name in names if name in PARTS}
    if parts:
        q, dq, ddq = (torch.from_numpy(each) for each in motion)
        wanted = {part.component for part in parts.values()}
        pushed = None if tau is None else torch.from_numpy(tau)
        try:
            estimates = dynamics.components(model, Motion(q, dq, ddq), sorted(wanted), pushed)
        except dynamics.IndefiniteInertiaError as error:
            raise invalid_request(
                f"q[{error.index}]" if motion.shape[1] > 1 else "q",
                "a posture whose learnt inertia matrix is not positive definite",
                "for forward_dynamics a posture whose inertia the training data tell",
            ) from error
        for name, part in parts.items():
            estimate = estimates[part.component]
            values: Array = (estimate.std if part.std else estimate.mean).numpy()
            found[name] = values[:, None] if values.ndim == 1 else values
    return found


def _torques(model: TorqueModel, motion: Array, names: frozenset[str]) -> dict[str, Array]:
    if "covariance" in names:
        batch = model.predict(motion[0], motion[1], motion[2], covariance=True)
        assert batch.covariance is not None  # it is asked for
        return {"tau": batch.tau, "tau_std": batch.tau_std, "covariance": batch.covariance}
    if "tau_std" in names and motion.shape[1] > 1:
        batch = model.predict(motion[0], motion[1], motion[2])
        return {"tau": batch.tau, "tau_std": batch.tau_std}
    if "tau_std" in names:
        tau, std = model.answer(motion[:, 0])
        assert std is not None  # it is asked for
        return {"tau": tau[None], "tau_std": std[None]}
    if "tau" in names:  # the mean of one query costs less than its share of a batch with standard deviations
        each = np.ascontiguousarray(motion.transpose(1, 0, 2))
        return {"tau": np.stack([model.answer(one, std=False)[0] for one in each])}
    return {}
