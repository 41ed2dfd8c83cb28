"""Estimated arm of a version: joint frames, bodies, rotors and friction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lipserve.records import models
from lipserve.results import Array, Plain, array, html_table, text_table

LIMITS = (
    "Torque does not distinguish an arm from its mirror image, nor determine where a frame is along its axis.",
    "Masses are the closest physically consistent ones; torque deviation is the RMS change of torque that this causes.",
    "± is one standard deviation.",
)
FRICTION = {
    "viscous": "viscous N·m·s/rad",
    "coulomb": "Coulomb N·m",
    "offset": "offset N·m",
    "stribeck": "at low speed N·m",
    "position": "varying over a turn N·m",
    "load": "share of the load",
    "gain": "gain error",
    "breakaway": "breakaway N·m",
    "stiffness": "presliding N·m/rad",
}
Columns = dict[str, list[str]]


@dataclass(frozen=True, eq=False)
class Frames(Plain):
    """Joint frames in the base frame, with all joints at zero, from base to tip."""

    mode: str
    """`learn`, `calibrate` or `fixed`."""
    axis: Array
    """(n, 3) directions of the joint axes."""
    place: Array
    """(n, 3) origins of the joint frames, m."""
    turn_std: tuple[tuple[float, ...], ...]
    """Per joint, standard deviations of its rotation across its axis, rad; empty if there are none."""
    shift_std: tuple[tuple[float, ...], ...]
    """Per joint, standard deviations of its position across its axis, m; empty if there are none."""


@dataclass(frozen=True, eq=False)
class Arm(Plain):
    """Estimated arm of n joints, from base to tip; `print` shows it as tables."""

    joint_names: tuple[str, ...]
    joint_types: tuple[str, ...]
    frames: Frames
    mass: Array
    """(n,) masses, kg."""
    mass_std: Array
    """(n,) standard deviations of the masses, kg."""
    centre: Array
    """(n, 3) centres of mass in the joint frames, m."""
    centre_std: Array
    """(n, 3) their standard deviations to first order, m."""
    rotor: Array
    """(n,) rotor inertias, kg·m² (prismatic: kg)."""
    rotor_std: Array
    """(n,) standard deviations of the rotor inertias."""
    deviation: Array
    """(n,) RMS difference between the torque of these bodies and that of the estimate, N·m (prismatic: N)."""
    friction: Mapping[str, tuple[Array, Array]]
    """Means and standard deviations, (n,) each, of `viscous`, `coulomb` and `offset`; `stribeck`, `position`,
    `load`, `gain`, `breakaway` and `stiffness` if estimated."""
    undetermined: tuple[tuple[str, ...], ...]
    """Per joint, parameters that are unidentifiable from torque."""

    def tables(self) -> dict[str, Columns]:
        """Return tables by title, as columns of texts with one row per joint."""
        names, undetermined = list(self.joint_names), [", ".join(each) or "-" for each in self.undetermined]
        frames = {
            "joint": names,
            "type": list(self.joint_types),
            "axis": [_vector(each) for each in self.frames.axis],
            "position m": [_vector(each) for each in self.frames.place],
            "rotation std °": [_list(np.degrees(each)) for each in self.frames.turn_std],
            "position std mm": [_list(1000 * np.array(each)) for each in self.frames.shift_std],
        }
        bodies = {
            "joint": names,
            "mass kg": _pairs(self.mass, self.mass_std),
            **{f"centre {axis} m": _pairs(self.centre[:, k], self.centre_std[:, k]) for k, axis in enumerate("xyz")},
            "rotor kg·m²": _pairs(self.rotor, self.rotor_std),
            "torque deviation N·m": [f"{each:.2g}" for each in self.deviation],
            "unidentifiable": undetermined,
        }
        terms = {head: _pairs(*self.friction[name]) for name, head in FRICTION.items() if name in self.friction}
        return {
            "joint frames, all joints at zero, in the base frame": frames,
            "bodies, in their joint frames": bodies,
            "friction": {"joint": names, **terms},
        }

    def __str__(self) -> str:
        return "\n\n".join([*(text_table(title, columns) for title, columns in self.tables().items()), *LIMITS])

    def _repr_html_(self) -> str:
        tables = "".join(html_table(title, columns) for title, columns in self.tables().items())
        return tables + "".join(f"<p>{each}</p>" for each in LIMITS)


class Version(models.Version, frozen=True, kw_only=True):
    """Version of a model; `arm` is its estimated arm, and `print` shows it."""

    @property
    def arm(self) -> Arm | None:
        """Estimated arm, None for an estimator without rigid bodies."""
        return read_arm(self)

    def __str__(self) -> str:
        joints = f"{len(self.joint_names)} joints: {', '.join(self.joint_names)}"
        title = f"{self.model} version {self.version}: {self.estimator}, {joints}"
        title = "\n".join([title, *(f"warning: {each}" for each in self.warnings)])
        return title if self.arm is None else f"{title}\n\n{self.arm}"


def read_arm(version: models.Version) -> Arm | None:
    """Return the estimated arm of a version, None for an estimator without rigid bodies."""
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
        if joint.get("root"):
            turn, place = np.eye(3), np.zeros(3)
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
