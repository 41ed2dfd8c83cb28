"""Gravity torque of a model at given positions."""

from __future__ import annotations

import numpy as np

from lipcore.data.motion import Motion
from lipcore.model import dynamics
from lipcore.vocabulary import ENERGY_ESTIMATORS, offered_components
from service.contract.predictions import GravityRequest, GravityResponse
from service.foundation.errors import invalid_request
from service.inference.predicting import Query, check_answer, check_count, check_shapes, model_with_payload
from service.models.loaded import LoadedModels, ServedModel


def gravity(
    loaded: LoadedModels, model: str, request: GravityRequest, served: ServedModel | None = None
) -> GravityResponse:
    """Return the gravity torque at N positions. Blocking: use it in a thread.

    Raise InvalidRequestError, also if the model has no gravity, or NotFoundError.
    `served` is the version if the caller has found it.
    """
    served = served or loaded.get(model, request.version, request.alias)
    known = served.model
    if known.torque_convention == "gravity_compensated":
        message = f"`{model}` has no gravity: it was trained on torque without gravity (`gravity_compensated`)."
        raise invalid_request("model", model, "a model of torque with gravity", message)
    if "gravity" not in offered_components(known.estimator.name):
        expected = f"a model of estimator {', '.join(ENERGY_ESTIMATORS)}"
        message = f"`{model}` cannot separate gravity from other torque: its estimator is {known.estimator.name}."
        raise invalid_request("model", model, expected, message)
    (q,) = check_shapes(request, known)
    single, q = q.ndim == 1, np.atleast_2d(q)
    check_count("q", f"{len(q)} queries", len(q), components=True)
    Query(q[None], single).check(known.position_limits(loaded.storage.settings.max_position))
    rest = np.zeros_like(q)
    found = dynamics.components(model_with_payload(served, request.payload), Motion(q, rest, rest), ["gravity"])
    mean, std = (each[0] if single else each for each in (found["gravity"].mean, found["gravity"].std))
    check_answer("mean", mean)
    return GravityResponse(
        model=served.name,
        version=served.version,
        revision=served.revision,
        joint_names=list(known.joint_names),
        mean=mean.tolist(),
        std=std.tolist(),
    )
