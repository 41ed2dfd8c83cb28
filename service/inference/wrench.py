"""External wrench at given motions and measured torques."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lipcore.model.torque_model import TorqueModel
from lipcore.model.wrench import NoWrenchError, Wrench, external_wrench, has_wrench
from service.contract.wrench import WrenchRequest, WrenchResponse
from service.foundation.errors import invalid_request
from service.inference.predicting import Query, check_answer, check_count, check_shapes, model_with_payload
from service.models.served import ServedModel
from service.storage.storage import Storage

Array = NDArray[np.float64]
PARTS = ("link", "link_covariance", "base", "base_covariance")
POSE_TOLERANCE = 1e-6
"""Max deviation of a rotation matrix from an orthonormal one."""


def wrench(storage: Storage, served: ServedModel, request: WrenchRequest) -> WrenchResponse:
    """Return the external wrench at N motions.

    Raise InvalidRequestError, also if the model has no wrench or a posture is singular, or NotFoundError.
    """
    known = served.model
    if not has_wrench(known):
        message = (
            f"`{served.name}` has no wrench: train it with a URDF, the option geometry `fixed` or `calibrate`, and one "
            "arm of at least 6 joints."
        )
        expected = "a model of one arm with the geometry of a URDF and at least 6 joints"
        raise invalid_request("model", served.name, expected, message)
    parts = check_shapes(request, known)
    query = Query(np.stack([np.atleast_2d(values) for values in parts]), request.q.ndim == 1)
    count = query.values.shape[1]
    check_count("q", f"{count} queries", count, components=True)
    query.check(known.position_limits(storage.settings.max_position))
    tool = None if request.tool is None else _check_pose(request.tool)
    motions = query.values[:3].swapaxes(0, 1)
    found = wrenches(model_with_payload(served, request.payload), query, motions, served.scales.of(None), tool)
    values = {part: np.stack([getattr(each, part) for each in found]) for part in PARTS}
    for part in PARTS:
        check_answer(part, values[part])
    return WrenchResponse(
        model=served.name,
        version=served.version,
        revision=served.revision,
        joint_names=list(known.joint_names),
        **{part: (each[0] if query.single else each).tolist() for part, each in values.items()},
    )


def wrenches(model: TorqueModel, query: Query, motions: Array, scale: Array, tool: Array | None = None) -> list[Wrench]:
    """Return the wrench of each row of a query with torques; raise InvalidRequestError for a singular posture.

    motions: (N, 3, n), or wider with deflections.
    """
    found = []
    for row, (motion, tau) in enumerate(zip(motions, query.values[3], strict=True)):
        try:
            found.append(external_wrench(model, np.ascontiguousarray(motion), tau, scale, tool))
        except NoWrenchError as error:
            field = "q" if query.single else f"q[{row}]"
            message = f"At `{field}`, {error}."
            raise invalid_request(field, "a singular posture", "a posture away from singular ones", message) from error
    return found


def _check_pose(pose: Array) -> Array:
    """Return a pose, (4, 4); raise InvalidRequestError unless it is a rotation and a translation."""
    expected = "a 4 × 4 matrix of a rotation and a translation, last row 0 0 0 1"
    if pose.shape != (4, 4):
        raise invalid_request("tool", f"of shape {pose.shape}", expected)
    turn = pose[:3, :3]
    off = np.concatenate([(turn @ turn.T - np.eye(3)).ravel(), pose[3] - [0.0, 0.0, 0.0, 1.0]])
    if not (np.abs(off).max() < POSE_TOLERANCE and np.linalg.det(turn) > 0 and np.isfinite(pose).all()):
        raise invalid_request("tool", "not a pose", expected)
    return pose
