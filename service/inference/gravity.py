"""Gravity torque of a model at given positions."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from lipcore.model.equation import UnavailableComponentError
from service.contract.wrench import GravityRequest, GravityResponse
from service.foundation.errors import invalid_request
from service.inference.predicting import Query, check_answer, check_count, check_shapes, model_with_payload
from service.models.served import ServedModel
from service.storage.storage import Storage


@contextmanager
def explain_unavailable(model: str) -> Iterator[None]:
    """Raise InvalidRequestError instead of UnavailableComponentError in the block. model: name of the model."""
    try:
        yield
    except UnavailableComponentError as error:
        raise invalid_request("model", model, error.expected, str(error)) from error


def gravity(storage: Storage, served: ServedModel, request: GravityRequest) -> GravityResponse:
    """Return the gravity torque at N positions.

    Raise InvalidRequestError, also if the model has no gravity, or NotFoundError.
    """
    known = served.model
    (q,) = check_shapes(request, known)
    q = np.atleast_2d(q)
    check_count("q", f"{len(q)} queries", len(q), components=True)
    Query(q[None], request.q.ndim == 1).check(known.position_limits(storage.settings.max_position))
    with explain_unavailable(served.name):
        found = model_with_payload(served, request.payload).gravity(request.q)
    check_answer("mean", found.mean)
    return GravityResponse(
        model=served.name,
        version=served.version,
        revision=served.revision,
        joint_names=list(known.joint_names),
        mean=found.mean.tolist(),
        std=found.std.tolist(),
    )
