"""Components of a prediction: what a request may ask for, and how the answer is shaped."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lipcore.data.motion import Motion
from lipcore.model import dynamics
from lipcore.model.torque_model import TorqueModel
from lipcore.vocabulary import ComponentName
from service.foundation.errors import invalid_request
from service.inference.schema import PredictRequest


def check(model: TorqueModel, request: PredictRequest, limit: int) -> None:
    """Raise InvalidRequestError for components the model lacks, too many queries, or a torque missing or in vain."""
    offered = dynamics.available(model.estimator)
    for index, name in enumerate(request.components):
        if name not in offered:
            expected = f"what a model with the estimator {model.estimator.name} offers: {', '.join(offered)}"
            raise invalid_request(f"components[{index}]", name, expected)
    if request.components and request.q.ndim == 2 and len(request.q) > limit:
        raise invalid_request("q", f"{len(request.q)} queries", f"at most {limit} in one request with components")
    forward = "forward_dynamics" in request.components
    if forward and request.tau is None:
        raise invalid_request("tau", "missing", "the torque that forward_dynamics is asked for, shaped as q")
    if request.tau is not None and not forward:
        raise invalid_request("tau", "given", "no tau, or forward_dynamics among the components")


def answer(model: TorqueModel, request: PredictRequest) -> dict[ComponentName, dict[str, Any]]:
    """Mean and std by name, shaped as the query; raise InvalidRequestError where inertia cannot be inverted."""
    single = request.q.ndim == 1
    motion = Motion(_rows(request.q), _rows(request.dq), _rows(request.ddq))
    tau = None if request.tau is None else _rows(request.tau)
    try:
        found = dynamics.components(model, motion, request.components, tau)
    except dynamics.IndefiniteInertiaError as error:
        field = "q" if single else f"q[{error.index}]"
        raise invalid_request(
            field,
            "a posture whose learnt inertia matrix is not positive definite",
            "for forward_dynamics a posture whose inertia the training data tell",
        ) from error
    return {
        name: {
            "mean": (found[name].mean[0] if single else found[name].mean).tolist(),
            "std": (found[name].std[0] if single else found[name].std).tolist(),
        }
        for name in request.components
    }


def _rows(values: NDArray[np.float64]) -> torch.Tensor:
    return torch.from_numpy(np.atleast_2d(values))
