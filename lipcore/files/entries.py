"""The parts of a manifest's entries, and the entries of an arm.

A list has one item a joint (`check_lengths`); other sequences are tuples.
"""

import re
from collections.abc import Iterable
from typing import Annotated, Any

import numpy as np
from msgspec import UNSET, Meta, Struct, UnsetType

from lipcore.data.samples import Array
from lipcore.kernels.geometry import Geometry
from lipcore.model.parameters import STEPS
from lipcore.model.selection import Count
from lipcore.robots.urdf import PARAMETERS
from lipcore.vocabulary import GEOMETRY_MODES, JOINT_TYPES

MAX_VALUE = 1e12
"""Max magnitude of motion, torque and parameters, SI."""


def one_of(words: Iterable[str]) -> Meta:
    """Return the constraint of a text to these words; its error names them, unlike that of a Literal."""
    return Meta(pattern=rf"^({'|'.join(map(re.escape, words))})\Z")


Number = Annotated[float, Meta(ge=-MAX_VALUE, le=MAX_VALUE)]
NonNegative = Annotated[float, Meta(ge=0, le=MAX_VALUE)]
"""A deviation, a duration or another number of at least zero."""
JointKind = Annotated[str, one_of(JOINT_TYPES)]
Vector = tuple[Number, Number, Number]
Matrix = tuple[Vector, Vector, Vector]
Steps = Annotated[tuple[Number, ...], Meta(max_length=2)]
"""Standard deviations of a joint's two turns or shifts, empty if these are fixed."""


class Entry(Struct, forbid_unknown_fields=True):
    """An object with these fields and no others."""


class Estimate(Entry):
    """Mean and standard deviation of a number of each joint."""

    mean: list[Number]
    std: list[NonNegative]


class Friction(Entry):
    """See `lipcore.model.parameters.Friction`."""

    viscous: Estimate
    coulomb: Estimate
    offset: Estimate
    stribeck: Estimate | UnsetType = UNSET
    position: Estimate | UnsetType = UNSET
    load: Estimate | UnsetType = UNSET
    gain: Estimate | UnsetType = UNSET
    breakaway: Estimate | UnsetType = UNSET
    stiffness: Estimate | UnsetType = UNSET


class BodyParameters(Entry):
    """Ten parameters of a body: see `lipcore.model.parameters.InertialParameters`."""

    mass: Number
    first_moment: Vector
    inertia: tuple[Number, Number, Number, Number, Number, Number]


class Body(Entry):
    """The body that a joint moves."""

    joint: str
    mean: BodyParameters
    std: BodyParameters
    plausible: BodyParameters
    undetermined: tuple[Annotated[str, one_of(BodyParameters.__struct_fields__)], ...]


class Inertia(Entry):
    """Bodies in the order of the data."""

    mean_is_plausible: bool
    bodies: list[Body]
    plausible_deviation: list[Number]

    def plausible(self) -> Array:
        """Return the ten physically possible parameters of each body, (n, 10)."""
        each = [(body.plausible.mass, *body.plausible.first_moment, *body.plausible.inertia) for body in self.bodies]
        return np.array(each, np.float64).reshape(-1, PARAMETERS)


class JointPose(Entry):
    """Pose of a joint in the frame of the previous one."""

    rotation: Matrix
    translation: Vector


class Joint(JointPose):
    """A joint of a chain: see `lipcore.kernels.geometry.Geometry`."""

    joint: str
    type: JointKind
    axis: Vector
    across: tuple[Vector, Vector]
    turn_std: Steps
    shift_std: Steps
    undetermined: tuple[Annotated[str, one_of(STEPS)], ...]
    plausible: JointPose | UnsetType = UNSET
    """Pose for the plausible bodies, if it differs."""
    root: bool | UnsetType = UNSET
    """Whether this is the first joint of the second arm or a later one. Its pose is in the frame of the base."""

    def __post_init__(self) -> None:
        for name in ("turn_std", "shift_std"):
            if len(getattr(self, name)) == 1:
                raise ValueError(f"{name} has 1 value, expected 2 or none")


class Chain(Entry):
    """Joints from base to tip, arm after arm. order: the data's joint at each index."""

    mode: Annotated[str, one_of(GEOMETRY_MODES)]
    gravity: Vector
    order: list[Count]
    joints: list[Joint]

    def __post_init__(self) -> None:
        if sorted(self.order) != list(range(len(self.order))):
            raise ValueError(f"order is {self.order}, expected each of the joints 0 to {len(self.order) - 1} once")
        for plausible in (False, True):
            self.geometry(plausible)

    def geometry(self, plausible: bool = False) -> Geometry:
        """Return the geometry, optionally of the plausible bodies; raise ValueError for an invalid rotation matrix."""
        places = [each.plausible if plausible and each.plausible is not UNSET else each for each in self.joints]
        kinds: tuple[Any, ...] = tuple(joint.type for joint in self.joints)
        return Geometry(
            joint_types=kinds,
            gravity=np.array(self.gravity),
            rotation=np.array([place.rotation for place in places]),
            translation=np.array([place.translation for place in places]),
            axis=np.array([joint.axis for joint in self.joints]),
            roots=(0, *(index for index, joint in enumerate(self.joints) if joint.root is True)),
        )


class Parameters(Entry):
    """The parameters of a model, as `lipcore.model.parameters.report` returns them."""

    friction: Friction
    inertia: Inertia | UnsetType = UNSET
    rotor: Estimate | UnsetType = UNSET
    geometry: Chain | UnsetType = UNSET

    def __post_init__(self) -> None:
        if len({each is UNSET for each in (self.inertia, self.rotor, self.geometry)}) > 1:
            raise ValueError("inertia, rotor and geometry are not all present, expected all of them or none")


def check_lengths(where: str, entry: Any, n: int) -> None:
    """Raise ValueError for a list in an entry that has not one item for each of n joints."""
    if isinstance(entry, list):
        if len(entry) != n:
            raise ValueError(f"{where} is a list of {len(entry)} entries, expected {n}, one for each joint")
        for index, each in enumerate(entry):
            check_lengths(f"{where}[{index}]", each, n)
    elif isinstance(entry, Struct):
        for name in entry.__struct_fields__:
            check_lengths(f"{where}.{name}".lstrip("."), getattr(entry, name), n)
