"""An arm as tensors, for a model's file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from lipcore.kernels.arm_prior import Alternative, Arm
from lipcore.kernels.friction import friction_terms
from lipcore.kernels.geometry import Geometry
from lipcore.strict_json import quote
from lipcore.vocabulary import GEOMETRY_MODES, GeometryMode, JointType

PREFIX = "arm/"
_GEOMETRY = ("rotation", "translation", "axis", "gravity")
_ARM = ("parameters", "centre", "unit", "expected", "widths")
_OTHERS = ("rotation", "translation", "axis", "parameters", "linear", "probability")
_NAMES = {
    f"{PREFIX}{name}" for name in (*_GEOMETRY, *_ARM, "order", "stribeck", *(f"other/{name}" for name in _OTHERS))
}


def is_of_arm(name: str) -> bool:
    """Whether a tensor of this name belongs to an arm."""
    return name in _NAMES


def arm_tensors(arm: Arm) -> dict[str, Tensor]:
    """All numbers of an arm, float64, by name."""
    parts = {name: getattr(arm.geometry, name) for name in _GEOMETRY} | {name: getattr(arm, name) for name in _ARM}
    parts["order"] = arm.order.astype(np.float64)
    if arm.stribeck:
        parts["stribeck"] = np.ones(1)
    if each := arm.alternatives:
        parts |= {
            "other/rotation": np.stack([one.geometry.rotation for one in each]),
            "other/translation": np.stack([one.geometry.translation for one in each]),
            "other/axis": np.stack([one.geometry.axis for one in each]),
            "other/parameters": np.stack([one.parameters for one in each]),
            "other/linear": np.stack([np.concatenate([one.rotor[:, None], one.friction], axis=1) for one in each]),
            "other/probability": np.array([one.probability for one in each]),
        }
    return {f"{PREFIX}{name}": torch.from_numpy(np.array(value, np.float64)) for name, value in parts.items()}


def read_mode(mode: object) -> GeometryMode:
    """How the geometry of a stored arm was come by; raise ValueError for what is no such way."""
    if mode not in GEOMETRY_MODES:
        raise ValueError(f"fit.geometry is {quote(mode)}, expected one of {', '.join(GEOMETRY_MODES)}")
    kind: GeometryMode = mode
    return kind


def read_arm(tensors: Mapping[str, Tensor], joint_types: Sequence[JointType], mode: GeometryMode) -> Arm:
    """The arm that `arm_tensors` stored; joint_types: in the order of the data; mode: how its geometry was come by.

    Raise ValueError for tensors that are missing or do not fit together.
    """
    try:
        parts = {name: tensors[f"{PREFIX}{name}"].numpy() for name in (*_GEOMETRY, *_ARM, "order")}
    except KeyError as error:
        raise ValueError(f"tensor {error} is missing: the model is of an earlier release, train it again") from None
    order = parts.pop("order").astype(np.int64)
    if order.shape != (len(joint_types),) or sorted(order.tolist()) != list(range(len(joint_types))):
        raise ValueError(f"tensor 'arm/order' is {order.tolist()}, expected each joint once")
    types = tuple(joint_types[joint] for joint in order)
    geometry = Geometry(types, *(parts.pop(name) for name in _GEOMETRY))
    stribeck = _stribeck(tensors)
    alternatives = _alternatives(tensors, geometry, len(friction_terms(stribeck)))
    return Arm(geometry, order, mode, stribeck=stribeck, alternatives=alternatives, **parts)


def _stribeck(tensors: Mapping[str, Tensor]) -> bool:
    """Whether friction has its fourth term: it has not where nothing is stored."""
    if (stored := tensors.get(f"{PREFIX}stribeck")) is None:
        return False
    if (values := stored.tolist()) not in ([0.0], [1.0]):
        raise ValueError(f"tensor 'arm/stribeck' is {quote(values)}, expected [0.0] or [1.0]")
    return bool(values[0])


def _alternatives(tensors: Mapping[str, Tensor], geometry: Geometry, terms: int) -> tuple[Alternative, ...]:
    """terms: of friction."""
    if f"{PREFIX}other/probability" not in tensors:
        return ()
    try:
        rotation, translation, axis, parameters, linear, probability = (
            tensors[f"{PREFIX}other/{name}"].numpy() for name in _OTHERS
        )
    except KeyError as error:
        raise ValueError(f"tensor {error} is missing") from None
    n, count = geometry.n_joints, probability.size
    for name, value, shape in (
        ("parameters", parameters, (count, n, 10)),
        ("linear", linear, (count, n, 1 + terms)),
        ("rotation", rotation, (count, n, 3, 3)),
        ("translation", translation, (count, n, 3)),
        ("axis", axis, (count, n, 3)),
        ("probability", probability, (count,)),
    ):
        if value.shape != shape or not count:
            raise ValueError(f"tensor 'arm/other/{name}' has shape {value.shape}, expected {shape}")
    if not ((probability > 0) & (probability < 1)).all():
        raise ValueError("tensor 'arm/other/probability' holds a number that is none between 0 and 1")
    return tuple(
        Alternative(
            Geometry(geometry.joint_types, rotation[k], translation[k], axis[k], geometry.gravity),
            parameters[k],
            linear[k, :, 0],
            np.ascontiguousarray(linear[k, :, 1:]),
            float(probability[k]),
        )
        for k in range(count)
    )
