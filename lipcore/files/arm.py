"""An arm as tensors of a model's files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from lipcore.data.samples import Array
from lipcore.files.strict_json import quote
from lipcore.kernels.arm_prior import Alternative, Arm
from lipcore.kernels.drive.terms import drive_terms
from lipcore.kernels.geometry import Geometry
from lipcore.vocabulary import DRIVE_KINDS, DriveKind, GeometryMode, JointType

PREFIX = "arm/"
_GEOMETRY_TENSORS = ("rotation", "translation", "axis", "gravity")
_ARM_TENSORS = ("parameters", "centre", "unit", "expected", "widths")
_ALTERNATIVE_TENSORS = ("rotation", "translation", "axis", "parameters", "linear", "probability")
_TENSORS = {
    f"{PREFIX}{name}"
    for name in (
        *_GEOMETRY_TENSORS,
        *_ARM_TENSORS,
        "order",
        "roots",
        "rotor",
        "drive",
        "acceleration",
        "stribeck",
        *(f"other/{name}" for name in _ALTERNATIVE_TENSORS),
    )
}


def is_arm_tensor(name: str) -> bool:
    """Return whether a tensor of this name belongs to an arm."""
    return name in _TENSORS


def arm_tensors(arm: Arm) -> dict[str, Array]:
    """Return all numbers of an arm, float64, by name."""
    parts = {name: getattr(arm.geometry, name) for name in _GEOMETRY_TENSORS} | {
        name: getattr(arm, name) for name in _ARM_TENSORS
    }
    parts["order"] = arm.order.astype(np.float64)
    if len(arm.geometry.roots) > 1:
        parts["roots"] = np.array(arm.geometry.roots, np.float64)
    if arm.rotor.any():
        parts["rotor"] = arm.rotor
    if arm.drive:
        parts["drive"] = np.array([float(kind in arm.drive) for kind in DRIVE_KINDS])
    if arm.acceleration is not None:
        parts["acceleration"] = arm.acceleration
    if each := arm.alternatives:
        parts |= {
            "other/rotation": np.stack([one.geometry.rotation for one in each]),
            "other/translation": np.stack([one.geometry.translation for one in each]),
            "other/axis": np.stack([one.geometry.axis for one in each]),
            "other/parameters": np.stack([one.parameters for one in each]),
            "other/linear": np.stack([np.concatenate([one.rotor[:, None], one.friction], axis=1) for one in each]),
            "other/probability": np.array([one.probability for one in each]),
        }
    return {f"{PREFIX}{name}": np.array(value, np.float64) for name, value in parts.items()}


def read_arm(tensors: Mapping[str, Array], joint_types: Sequence[JointType], mode: GeometryMode) -> Arm:
    """Return the arm that `arm_tensors` stored.

    joint_types: in the order of the data; mode: origin of its geometry. Raise ValueError for tensors that are missing
    or inconsistent.
    """
    try:
        parts = {name: tensors[f"{PREFIX}{name}"] for name in (*_GEOMETRY_TENSORS, *_ARM_TENSORS, "order")}
    except KeyError as error:
        raise ValueError(f"tensor {error} is missing") from None
    order = parts.pop("order").astype(np.int64)
    if order.shape != (len(joint_types),) or sorted(order.tolist()) != list(range(len(joint_types))):
        raise ValueError(f"tensor 'arm/order' is {order.tolist()}, expected each joint once")
    types = tuple(joint_types[joint] for joint in order)
    roots = tensors.get(f"{PREFIX}roots", np.zeros(1))  # stored for several arms
    if roots.ndim != 1 or not np.isfinite(roots).all():
        raise ValueError(f"tensor 'arm/roots' is {quote(roots.tolist())}, expected the first joint of each arm")
    frames = {name: parts.pop(name) for name in _GEOMETRY_TENSORS}
    geometry = Geometry(types, **frames, roots=tuple(map(int, roots)))
    rotor = tensors.get(f"{PREFIX}rotor")  # rotors of zero inertia are not stored
    parts["rotor"] = np.zeros(len(types)) if rotor is None else rotor
    drive, acceleration = _drive(tensors), tensors.get(f"{PREFIX}acceleration")
    if (acceleration is None) == ("play" in drive) or (acceleration is not None and not _is_usual(acceleration, types)):
        raise ValueError(
            "tensor 'arm/acceleration' is wrong, expected one positive number a joint if friction has play"
        )
    alternatives = _alternatives(tensors, geometry, len(drive_terms(drive)))
    return Arm(geometry, order, mode, drive=drive, acceleration=acceleration, alternatives=alternatives, **parts)


def _is_usual(acceleration: Array, types: Sequence[JointType]) -> bool:
    return acceleration.shape == (len(types),) and bool(np.isfinite(acceleration).all() and (acceleration > 0).all())


def _drive(tensors: Mapping[str, Array]) -> tuple[DriveKind, ...]:
    """Return the kinds of the drive; none if nothing is stored. Earlier releases stored `stribeck` alone."""
    kinds: list[DriveKind] = []
    for name, offered in (("stribeck", DRIVE_KINDS[:1]), ("drive", DRIVE_KINDS)):
        if (stored := tensors.get(f"{PREFIX}{name}")) is None:
            continue
        values = stored.tolist()
        if stored.shape != (len(offered),) or not set(values) <= {0.0, 1.0}:
            raise ValueError(f"tensor 'arm/{name}' is {quote(values)}, expected {len(offered)} numbers, each 0 or 1")
        kinds = [kind for kind, value in zip(offered, values, strict=True) if value]
    return tuple(kinds)


def _alternatives(tensors: Mapping[str, Array], geometry: Geometry, terms: int) -> tuple[Alternative, ...]:
    """Return the alternative arms. terms: number of friction terms a joint."""
    if f"{PREFIX}other/probability" not in tensors:
        return ()
    try:
        rotation, translation, axis, parameters, linear, probability = (
            tensors[f"{PREFIX}other/{name}"] for name in _ALTERNATIVE_TENSORS
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
        raise ValueError("tensor 'arm/other/probability' has a number outside 0 to 1")
    return tuple(
        Alternative(
            replace(geometry, rotation=rotation[k], translation=translation[k], axis=axis[k]),
            parameters[k],
            linear[k, :, 0],
            np.ascontiguousarray(linear[k, :, 1:]),
            float(probability[k]),
        )
        for k in range(count)
    )
