"""An arm in a model's files: its tensors, and its report in the manifest, which is checked while it is read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lipcore.data.samples import Array
from lipcore.files.checks import LARGEST, check_choice, check_keys, check_list, check_numbers, wrong
from lipcore.files.strict_json import quote
from lipcore.kernels.arm_prior import Alternative, Arm
from lipcore.kernels.friction import friction_terms
from lipcore.kernels.geometry import Geometry
from lipcore.model.parameters import STEPS
from lipcore.robots.urdf import PARAMETERS
from lipcore.vocabulary import GEOMETRY_MODES, JOINT_TYPES, GeometryMode, JointType

GEOMETRY_ENTRIES = ("mode", "gravity", "order", "joints")
JOINT_ENTRIES = ("joint", "type", "rotation", "translation", "axis", "across", "turn_std", "shift_std", "undetermined")
BODY_ENTRIES = ("joint", "mean", "std", "plausible", "undetermined")
MASSES = {"mass": (), "first_moment": (3,), "inertia": (6,)}
"""Entries of a body's ten parameters and their shapes."""
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
        "rotor",
        "stribeck",
        *(f"other/{name}" for name in _ALTERNATIVE_TENSORS),
    )
}


def check_inertia(inertia: Any, n: int) -> None:
    """Raise ValueError unless this is the entry `inertia` of n bodies; the message names what is wrong."""
    check_keys("inertia", inertia, ("mean_is_plausible", "plausible_deviation", "bodies"))
    numbers("inertia.plausible_deviation", inertia["plausible_deviation"], (n,))
    for index, body in enumerate(check_list("inertia.bodies", inertia["bodies"], n)):
        where = f"inertia.bodies[{index}]"
        check_keys(where, body, BODY_ENTRIES)
        for key in ("mean", "std", "plausible"):
            check_keys(f"{where}.{key}", body[key], MASSES)
            for name, shape in MASSES.items():
                numbers(f"{where}.{key}.{name}", body[key][name], shape)
        _check_words(f"{where}.undetermined", body["undetermined"], tuple(MASSES))


def check_rotor(rotor: Any, n: int) -> None:
    """Raise ValueError unless this is the entry `rotor` of n joints."""
    check_keys("rotor", rotor, ("mean", "std"))
    for key in ("mean", "std"):
        numbers(f"rotor.{key}", rotor[key], (n,))


def read_geometry(entry: Any, n: int, plausible: bool = False) -> tuple[Geometry, list[int]]:
    """The geometry of the entry `geometry`, and the data's joint at each place of the chain; raise ValueError.

    plausible: the one that the plausible bodies are meant for, where it is another one.
    """
    check_keys("geometry", entry, GEOMETRY_ENTRIES)
    check_choice("geometry.mode", entry["mode"], GEOMETRY_MODES)
    gravity = numbers("geometry.gravity", entry["gravity"], (3,))
    order = check_list("geometry.order", entry["order"], n)
    if any(isinstance(each, bool) or not isinstance(each, int) for each in order) or sorted(order) != list(range(n)):
        raise wrong("geometry.order", order, f"each of the joints 0 to {n - 1} once")
    joints = check_list("geometry.joints", entry["joints"], n)
    for place, joint in enumerate(joints):
        _check_joint(f"geometry.joints[{place}]", joint)
    placed = [{**joint, **(joint.get("plausible", {}) if plausible else {})} for joint in joints]
    shapes = {"rotation": (3, 3), "translation": (3,), "axis": (3,)}
    try:
        geometry = Geometry(
            joint_types=tuple(joint["type"] for joint in joints),
            gravity=gravity,
            **{key: np.array([numbers(key, joint[key], shape) for joint in placed]) for key, shape in shapes.items()},
        )
    except ValueError as error:
        raise ValueError(f"geometry: {error}") from None
    return geometry, order


def bodies_of(inertia: Mapping[str, Any], kind: str = "plausible") -> Array:
    """Ten parameters of each body of the entry `inertia`, (n, 10), in the order of the data.

    kind: `mean`, `std`, or `plausible`, the physically possible ones.
    """
    ten = [[body[kind]["mass"], *body[kind]["first_moment"], *body[kind]["inertia"]] for body in inertia["bodies"]]
    return np.array(ten, np.float64).reshape(-1, PARAMETERS)


def numbers(name: str, value: Any, shape: tuple[int, ...]) -> Array:
    """Nested lists of numbers as an array of a shape; raise ValueError for anything else."""
    check_numbers(name, value, shape, -LARGEST, LARGEST)
    return np.array(value, np.float64)


def _check_joint(where: str, joint: Any) -> None:
    check_keys(where, joint, JOINT_ENTRIES, ("plausible",))
    if "plausible" in joint:
        check_keys(f"{where}.plausible", joint["plausible"], ("rotation", "translation"))
        numbers(f"{where}.plausible.rotation", joint["plausible"]["rotation"], (3, 3))
        numbers(f"{where}.plausible.translation", joint["plausible"]["translation"], (3,))
    check_choice(f"{where}.type", joint["type"], JOINT_TYPES)
    for key, shape in (("rotation", (3, 3)), ("translation", (3,)), ("axis", (3,)), ("across", (2, 3))):
        numbers(f"{where}.{key}", joint[key], shape)
    for key in ("turn_std", "shift_std"):
        numbers(f"{where}.{key}", joint[key], (2 if joint[key] else 0,))
    _check_words(f"{where}.undetermined", joint["undetermined"], STEPS)


def _check_words(name: str, value: Any, known: Sequence[str]) -> None:
    if not isinstance(value, list) or any(each not in known for each in value):
        raise wrong(name, value, f"a list of some of {', '.join(known)}")


def is_of_arm(name: str) -> bool:
    """Whether a tensor of this name belongs to an arm."""
    return name in _TENSORS


def arm_tensors(arm: Arm) -> dict[str, Array]:
    """All numbers of an arm, float64, by name."""
    parts = {name: getattr(arm.geometry, name) for name in _GEOMETRY_TENSORS} | {
        name: getattr(arm, name) for name in _ARM_TENSORS
    }
    parts["order"] = arm.order.astype(np.float64)
    if arm.rotor.any():
        parts["rotor"] = arm.rotor
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
    return {f"{PREFIX}{name}": np.array(value, np.float64) for name, value in parts.items()}


def read_mode(mode: object) -> GeometryMode:
    """How the geometry of a stored arm was obtained; raise ValueError for none of GEOMETRY_MODES."""
    if mode not in GEOMETRY_MODES:
        raise ValueError(f"fit.geometry is {quote(mode)}, expected one of {', '.join(GEOMETRY_MODES)}")
    kind: GeometryMode = mode
    return kind


def read_arm(tensors: Mapping[str, Array], joint_types: Sequence[JointType], mode: GeometryMode) -> Arm:
    """The arm that `arm_tensors` stored; joint_types: in the order of the data; mode: how its geometry was come by.

    Raise ValueError for tensors that are missing or do not fit together.
    """
    try:
        parts = {name: tensors[f"{PREFIX}{name}"] for name in (*_GEOMETRY_TENSORS, *_ARM_TENSORS, "order")}
    except KeyError as error:
        raise ValueError(f"tensor {error} is missing") from None
    order = parts.pop("order").astype(np.int64)
    if order.shape != (len(joint_types),) or sorted(order.tolist()) != list(range(len(joint_types))):
        raise ValueError(f"tensor 'arm/order' is {order.tolist()}, expected each joint once")
    types = tuple(joint_types[joint] for joint in order)
    geometry = Geometry(types, *(parts.pop(name) for name in _GEOMETRY_TENSORS))
    rotor = tensors.get(f"{PREFIX}rotor")  # nothing is stored where none is expected
    parts["rotor"] = np.zeros(len(types)) if rotor is None else rotor
    stribeck = _stribeck(tensors)
    alternatives = _alternatives(tensors, geometry, len(friction_terms(stribeck)))
    return Arm(geometry, order, mode, stribeck=stribeck, alternatives=alternatives, **parts)


def _stribeck(tensors: Mapping[str, Array]) -> bool:
    """Whether friction has its fourth term: it has not where nothing is stored."""
    if (stored := tensors.get(f"{PREFIX}stribeck")) is None:
        return False
    if (values := stored.tolist()) not in ([0.0], [1.0]):
        raise ValueError(f"tensor 'arm/stribeck' is {quote(values)}, expected [0.0] or [1.0]")
    return bool(values[0])


def _alternatives(tensors: Mapping[str, Array], geometry: Geometry, terms: int) -> tuple[Alternative, ...]:
    """terms: of friction."""
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
