"""What the effort of a recording is: torque with or without gravity, or motor current that constants turn into it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from lipcore.profiles import Profile
from lipcore.vocabulary import TorqueConvention
from service.datasets.mapping.recognition import AIM, CANONICAL, Family
from service.datasets.mapping.vocabulary import factor, is_current
from service.datasets.options import EFFORT_CONVENTIONS, Effort, UploadOptions
from service.foundation.errors import invalid_data, invalid_request

MEANINGS: dict[Effort, str] = {
    "measured": "torque as measured, gravity included",
    "commanded": "torque as commanded, without what compensates gravity",
    "current": "motor current, A",
}

BY_DEFAULT = "as nothing else is said"


@dataclass(frozen=True)
class Torque:
    """How the column of torque is taken. constants: N·m/A by joint, of motor currents."""

    effort: Effort
    convention: TorqueConvention
    constants: tuple[float, ...] | None
    notes: tuple[str, ...]


def named(family: Family) -> Effort:
    """What the names of columns say that they hold."""
    first = next(iter(family.members.values()), None)
    if family.kind == "current" or (first is not None and is_current(first.unit)):
        return "current"
    return "commanded" if family.rank == AIM else "measured"


def prefer(families: Sequence[Family], effort: Effort | None) -> list[Family]:
    """Those columns that best hold what the effort is said to be: by default measured torque, then current."""
    if effort == "current":
        order: tuple[Effort, ...] = ("current", "measured", "commanded")
    elif effort == "commanded":
        order = ("commanded", "measured")
    else:
        order = ("measured", "current", "commanded") if effort is None else ("measured", "commanded")
    for effort_of in order:
        if chosen := [family for family in families if named(family) == effort_of]:
            return chosen
    return []


def torque(
    family: Family,
    units: Sequence[str | None],
    options: UploadOptions,
    robot: Profile | None,
    constants: Sequence[float] | None,
) -> Torque:
    """Say what the chosen columns are; raise InvalidDataError where that contradicts itself.

    units: of the columns, as far as said; constants: of the robot's joints in the order of the columns.
    """
    effort, why = _effort(family, units, options, robot)
    notes = [f"{family.pattern} is taken as {MEANINGS[effort]}, {why}"]
    if why == BY_DEFAULT and family.rank == CANONICAL:
        notes = []  # as documented
    wrong = next((unit for unit in units if unit is not None and is_current(unit) != (effort == "current")), None)
    if wrong is not None and effort != "current":
        raise invalid_data(f"unit of {family.pattern}", wrong, f"a torque, as effort is {effort}; or effort=current")
    if wrong is not None and factor("tau", wrong) not in (None, 1.0):
        raise invalid_data(f"unit of {family.pattern}", wrong, "A or mA, as effort is current")
    given: tuple[float, ...] | None = None
    if effort == "current":
        given = _constants(options, constants, len(units))
        notes.append(f"torque is current times {', '.join(f'{value:g}' for value in given)} N·m/A of the joints")
    convention = options.torque_convention or EFFORT_CONVENTIONS[effort]
    if convention != EFFORT_CONVENTIONS[effort]:
        notes.append(f"the torque convention is {convention}, as the upload says, though effort is {effort}")
    return Torque(effort, convention, given, tuple(notes))


def _effort(
    family: Family, units: Sequence[str | None], options: UploadOptions, robot: Profile | None
) -> tuple[Effort, str]:
    given = options.read.effort
    if given is not None:
        return given, "as the upload says"
    by_name = named(family)
    if by_name != "measured":
        return by_name, "as the columns are called"
    if any(is_current(unit) for unit in units):
        return "current", "by its unit"
    if robot is not None and robot.effort in EFFORT_CONVENTIONS:
        # a robot's drivers put currents into its effort field; who calls a column torque has converted them
        if robot.effort == "commanded":
            return "commanded", f"as {robot.name} records it"
        if robot.effort == "current" and family.kind == "effort" and not any(units):
            return "current", f"as {robot.name} records it"
        if robot.effort == "measured":
            return "measured", f"as {robot.name} records it"
    if options.torque_convention == "gravity_compensated":
        return "commanded", "by its torque convention"
    return "measured", BY_DEFAULT


def _constants(options: UploadOptions, known: Sequence[float] | None, n: int) -> tuple[float, ...]:
    given = options.read.torque_constants
    if given is not None:
        if len(given) != n:
            raise invalid_request("torque_constants", f"{len(given)} values", f"{n}, one a joint that is kept")
        if not all(math.isfinite(value) and value != 0 for value in given):
            raise invalid_request("torque_constants", list(given), "finite numbers of N·m/A, none of them 0")
        return given
    if known is None or not all(math.isfinite(value) for value in known):
        raise invalid_data(
            "torque_constants",
            "missing",
            f"{n} numbers of N·m/A, one a joint, as effort is motor current; or effort=measured where it is torque",
        )
    return tuple(float(value) for value in known)
