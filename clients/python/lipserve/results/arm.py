"""The arm that a version has learnt: where its joints lie, what they carry, rotors and friction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lipserve.records import models
from lipserve.results import Array, Plain, array, html_table, text_table

LIMITS = (
    "Torque cannot tell an arm from its mirror image, nor where a frame lies along its axis.",
    "Masses are the physically possible ones nearest to what was learnt; torque off: how far theirs is from it, rms.",
    "± is one standard deviation.",
)
FRICTION = {
    "viscous": "viscous N·m·s/rad",
    "coulomb": "Coulomb N·m",
    "offset": "offset N·m",
    "stribeck": "at low speed N·m",
}
Columns = dict[str, list[str]]


@dataclass(frozen=True, eq=False)
class Frames(Plain):
    """Where n joints lie with all positions at zero, base to tip, in the base's frame.

    mode: `learn`, `calibrate` or `fixed`; axis: (n, 3) directions; place: (n, 3) m, origins of the joints' frames;
    turn_std, shift_std: of each joint, standard deviations across its axis, rad and m, empty where there are none.
    """

    mode: str
    axis: Array
    place: Array
    turn_std: tuple[tuple[float, ...], ...]
    shift_std: tuple[tuple[float, ...], ...]


@dataclass(frozen=True, eq=False)
class Arm(Plain):
    """What a version has learnt of an arm of n joints, base to tip; `print` shows it as tables.

    frames: where the joints lie; mass, mass_std: (n) kg; centre, centre_std: (n, 3) m, centres of mass in the joints'
    own frames, first moment over mass, their deviations to first order; rotor, rotor_std: (n) kg·m² (kg); deviation:
    (n) N·m (N), root mean square by which the torque of these bodies differs from what was learnt; friction: by
    `viscous`, `coulomb`, `offset` and, where it was learnt, `stribeck` means and standard deviations, (n) each;
    undetermined: what torque does not tell of each joint and its body.
    """

    joint_names: tuple[str, ...]
    joint_types: tuple[str, ...]
    frames: Frames
    mass: Array
    mass_std: Array
    centre: Array
    centre_std: Array
    rotor: Array
    rotor_std: Array
    deviation: Array
    friction: Mapping[str, tuple[Array, Array]]
    undetermined: tuple[tuple[str, ...], ...]

    def tables(self) -> dict[str, Columns]:
        """The tables by their titles: columns of texts, a row a joint."""
        names, undetermined = list(self.joint_names), [", ".join(each) or "-" for each in self.undetermined]
        frames = {
            "joint": names,
            "type": list(self.joint_types),
            "axis": [_vector(each) for each in self.frames.axis],
            "place m": [_vector(each) for each in self.frames.place],
            "turn std °": [_list(np.degrees(each)) for each in self.frames.turn_std],
            "shift std mm": [_list(1000 * np.array(each)) for each in self.frames.shift_std],
        }
        bodies = {
            "joint": names,
            "mass kg": _pairs(self.mass, self.mass_std),
            **{f"centre {axis} m": _pairs(self.centre[:, k], self.centre_std[:, k]) for k, axis in enumerate("xyz")},
            "rotor kg·m²": _pairs(self.rotor, self.rotor_std),
            "torque off N·m": [f"{each:.2g}" for each in self.deviation],
            "torque does not tell": undetermined,
        }
        terms = {head: _pairs(*self.friction[name]) for name, head in FRICTION.items() if name in self.friction}
        return {
            "where the joints lie, all at zero, in the base's frame": frames,
            "what the joints carry, in their own frames": bodies,
            "friction": {"joint": names, **terms},
        }

    def __str__(self) -> str:
        return "\n\n".join([*(text_table(title, columns) for title, columns in self.tables().items()), *LIMITS])

    def _repr_html_(self) -> str:
        tables = "".join(html_table(title, columns) for title, columns in self.tables().items())
        return tables + "".join(f"<p>{each}</p>" for each in LIMITS)


class Version(models.Version, frozen=True, kw_only=True):
    """A version as the API shows it; `arm` is what it has learnt of its arm, and `print` shows that."""

    @property
    def arm(self) -> Arm | None:
        """The arm, None for an estimator without rigid bodies."""
        return read_arm(self)

    def __str__(self) -> str:
        joints = f"{len(self.joint_names)} joints: {', '.join(self.joint_names)}"
        title = f"{self.model} version {self.version}: {self.estimator}, {joints}"
        title = "\n".join([title, *(f"careful: {each}" for each in self.warnings)])
        return title if self.arm is None else f"{title}\n\n{self.arm}"


def read_arm(version: models.Version) -> Arm | None:
    """The arm of a version; None where its estimator has no rigid bodies."""
    parameters = version.parameters
    if "inertia" not in parameters:
        return None
    shape, rotor = parameters["geometry"], parameters["rotor"]
    order = shape["order"]
    bodies = [parameters["inertia"]["bodies"][joint] for joint in order]
    mass, mass_std = (array([body[kind]["mass"] for body in bodies]) for kind in ("plausible", "std"))
    moment, moment_std = (array([body[kind]["first_moment"] for body in bodies]) for kind in ("plausible", "std"))
    centre = moment / mass[:, None]
    return Arm(
        joint_names=tuple(version.joint_names[joint] for joint in order),
        joint_types=tuple(version.joint_types[joint] for joint in order),
        frames=_frames(shape),
        mass=mass,
        mass_std=mass_std,
        centre=centre,
        centre_std=np.hypot(moment_std, centre * mass_std[:, None]) / mass[:, None],
        rotor=array(rotor["mean"])[order],
        rotor_std=array(rotor["std"])[order],
        deviation=array(parameters["inertia"]["plausible_deviation"])[order],
        friction={
            name: (
                array(parameters["friction"][name]["mean"])[order],
                array(parameters["friction"][name]["std"])[order],
            )
            for name in FRICTION
            if name in parameters["friction"]
        },
        undetermined=tuple(
            (*place["undetermined"], *(word.replace("_", " ") for word in body["undetermined"]))
            for place, body in zip(shape["joints"], bodies, strict=True)
        ),
    )


def _frames(shape: Mapping[str, Any]) -> Frames:
    turn, place, axes, places = np.eye(3), np.zeros(3), [], []
    for joint in shape["joints"]:
        place, turn = place + turn @ array(joint["translation"]), turn @ array(joint["rotation"])
        axes.append(turn @ array(joint["axis"]))
        places.append(place)
    stds = ({key: tuple(tuple(joint[key]) for joint in shape["joints"]) for key in ("turn_std", "shift_std")}).values()
    return Frames(shape["mode"], np.array(axes), np.array(places), *stds)


def _pairs(means: Array, stds: Array) -> list[str]:
    return [f"{mean:.3g} ± {std:.1g}" for mean, std in zip(means, stds, strict=True)]


def _vector(values: Array) -> str:
    return " ".join(f"{value + 0.0:.3f}" for value in np.round(values, 3))


def _list(values: Array) -> str:
    return ", ".join(f"{value:.2g}" for value in values) or "-"
