"""Torque constants of motor currents, estimated from the masses of the robot's URDF."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lipcore.data.motion import spaced_rows
from lipcore.data.samples import Array
from lipcore.profiles import Profile
from service.datasets.mapping.choice import format_numbers
from service.datasets.report.bodies import Signals, compare
from service.datasets.report.robots import MATCH, bodies_of
from service.datasets.report.texts import list_names
from service.datasets.staging import Prepared
from service.foundation.errors import invalid_data
from service.foundation.text import percent

MAX_ROWS = 2000
"""Max rows of the comparison."""
MIN_STDS = 5.0
"""Min factor of gravity or inertia, in its standard deviations: the constant is then known to 20 %."""


@dataclass(frozen=True)
class EstimatedConstants:
    """Torque constants of n joints, with a sentence on their origin."""

    values: Array
    """(n,) N·m/A."""
    text: str


def estimate_constants(prepared: Prepared, robot: Profile) -> EstimatedConstants:
    """Return the torque constants for which the currents are the torques of the robot's bodies.

    Each joint's current is fitted with the torque of gravity, of inertia and of friction (`bodies`). The constant is
    the inverse of the factor of gravity, or of inertia where gravity is not visible. A joint without both has the
    constant of the nearest joint: its motor is often the same. prepared: with currents, A, as torques.

    Raise InvalidDataError if no joint shows its constant.
    """
    staged = prepared.staged
    names, rows = staged.joint_names, spaced_rows(staged.rows, MAX_ROWS)
    bodies = bodies_of(robot, names)
    if bodies is None:
        raise _missing(len(names), f"robot {robot.name} has no URDF with masses of these joints")
    found = compare(bodies, Signals(*(staged.table(each, rows) for each in ("q", "dq", "ddq", "tau"))))
    fits = found.explained > MATCH.explained
    heavy = fits & (np.abs(found.gravity) > MIN_STDS * found.gravity_std)
    # a negative factor of inertia is an error of friction
    light = fits & ~heavy & (found.inertia > MIN_STDS * found.inertia_std)
    known = np.flatnonzero(heavy | light)
    if not len(known):
        raise _missing(len(names), f"the currents do not show the masses of robot {robot.name}")
    factor, std = np.where(heavy, found.gravity, found.inertia), np.where(heavy, found.gravity_std, found.inertia_std)
    nearest = known[np.abs(np.subtract.outer(np.arange(len(names)), known)).argmin(axis=1)]
    values, unknown = 1 / factor[nearest], np.setdiff1d(np.arange(len(names)), known)
    text = f"torque is motor current times {format_numbers(values.tolist())} N·m/A, estimated from the masses of "
    text += f"{robot.name} (standard deviation up to {percent(float((std / np.abs(factor))[known].max()))}"
    if light.any():
        text += f"; {list_names(np.array(names)[light])} by inertia, too low if the URDF lacks rotors"
    if len(unknown):
        text += f"; {list_names(np.array(names)[unknown])} like the nearest joint, as no mass is visible"
    return EstimatedConstants(values, f"{text}). Set torque_constants if you know them")


def _missing(n: int, why: str) -> Exception:
    return invalid_data(
        "torque_constants",
        "missing",
        f"{n} numbers in N·m/A, one per joint: they cannot be estimated, because {why}. Set effort=measured if it is "
        "torque",
    )
