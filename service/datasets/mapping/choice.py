"""Choosing the columns of each quantity if a file has several, and finding the kind of its effort.

Effort is torque with gravity, torque without gravity, or motor current that torque constants convert to torque.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from lipcore.profiles import Profile
from lipcore.vocabulary import TorqueConvention
from service.contract.uploads import Effort
from service.datasets.mapping.joints import WARNING, Joint, list_joints
from service.datasets.mapping.recognition import (
    JOINT,
    Family,
    Member,
    Rank,
    columns_hint,
    expand_pattern,
    find_families,
    interpret_name,
    keys_of_joints,
)
from service.datasets.mapping.vocabulary import is_current, unit_factor
from service.datasets.options import EFFORT_CONVENTIONS, UploadOptions
from service.foundation.errors import InvalidDataError, InvalidRequestError, invalid_data, invalid_request, readable

EFFORT_MEANINGS: dict[Effort, str] = {
    "measured": "measured torque, gravity included",
    "commanded": "commanded torque, without gravity compensation",
    "current": "motor current in A",
}

BY_DEFAULT, BY_NAME = "by default", "by the column names"


@dataclass(frozen=True)
class TorqueMeaning:
    """How the torque columns are read."""

    effort: Effort
    convention: TorqueConvention
    constants: tuple[float, ...] | None
    """Torque constants of motor currents by joint, N·m/A; None if they are unknown, or if torque is no current."""
    factors: tuple[float, ...] | None
    """Factors of the torques by joint."""
    notes: tuple[str, ...]


def effort_by_name(family: Family) -> Effort:
    """Return the effort that the names of columns indicate."""
    first = next(iter(family.members.values()), None)
    if family.kind == "current" or (first is not None and is_current(first.unit)):
        return "current"
    return "commanded" if family.rank == Rank.COMMANDED else "measured"


def prefer_effort(families: Sequence[Family], effort: Effort | None) -> list[Family]:
    """Return the families that best fit the effort; by default measured torque, then current."""
    if effort == "current":
        order: tuple[Effort, ...] = ("current", "measured", "commanded")
    elif effort == "commanded":
        order = ("commanded", "measured")
    else:
        order = ("measured", "current", "commanded") if effort is None else ("measured", "commanded")
    for effort_of in order:
        if chosen := [family for family in families if effort_by_name(family) == effort_of]:
            return chosen
    return []


def interpret_torque(
    family: Family,
    units: Sequence[str | None],
    options: UploadOptions,
    robot: Profile | None,
    constants: Sequence[float] | None,
    commanded: str | None = None,
) -> TorqueMeaning:
    """Return how to read the chosen torque columns; raise InvalidDataError for a contradiction.

    units: of the columns, if known; constants: of the robot's joints in the order of the columns; commanded: pattern of
    the columns of commanded torque that could be read instead, if any.
    """
    effort, why = _effort(family, units, options, robot)
    meaning = EFFORT_MEANINGS[effort]
    use = f"is assumed to be {meaning}" if why == BY_DEFAULT else f"is read as {meaning} ({why})"
    notes = [f"{family.pattern} {use}"]
    if why == BY_NAME and effort == "commanded":
        notes.append(
            f"{WARNING}{family.pattern} holds commanded torque, and no columns of measured torque were found. A model "
            f"should learn measured torque: name its columns with {columns_hint({'tau': '…{joint}…'})}, or set "
            "effort=commanded if commanded torque is intended."
        )
    if why == BY_DEFAULT and family.rank == Rank.CANONICAL:
        notes = []  # the documented case
    wrong = next((unit for unit in units if unit is not None and is_current(unit) != (effort == "current")), None)
    if wrong is not None and effort != "current":
        raise invalid_data(
            f"unit of {family.pattern}",
            wrong,
            f"a unit of torque because effort is {effort}. Set effort=current if it is current",
        )
    if wrong is not None and unit_factor("tau", wrong) not in (None, 1.0):
        raise invalid_data(f"unit of {family.pattern}", wrong, "A or mA because effort is current")
    given: tuple[float, ...] | None = None
    if effort == "current":
        given = _constants(options, robot, constants, len(units), commanded)
        if given is not None:
            notes.append(f"torque is motor current times the torque constants {format_numbers(given)} N·m/A")
    elif options.read.torque_constants is not None:
        raise invalid_request(
            "torque_constants",
            format_numbers(options.read.torque_constants),
            f"no `torque_constants` because {family.pattern} {use}. Set effort=current if it is motor current",
        )
    factors = options.read.torque_factors
    if factors is not None:
        if len(factors) != len(units):
            raise _wrong_count("torque_factors", "torque factors", len(factors), len(units))
        notes.append(f"torque is multiplied by {format_numbers(factors)}, as set by `torque_factors`")
    convention = options.torque_convention or EFFORT_CONVENTIONS[effort]
    if convention != EFFORT_CONVENTIONS[effort]:
        notes.append(f"the torque convention is {convention}, as set by the upload, although effort is {effort}")
    return TorqueMeaning(effort, convention, given, factors, tuple(notes))


def format_numbers(values: Sequence[float]) -> str:
    """Return numbers in the form of an upload option, four digits each."""
    return ", ".join(f"{value:.4g}" for value in values)


def _effort(
    family: Family, units: Sequence[str | None], options: UploadOptions, robot: Profile | None
) -> tuple[Effort, str]:
    given = options.read.effort
    if given is not None:
        return given, "as set by `effort`"
    by_name = effort_by_name(family)
    if by_name != "measured":
        return by_name, BY_NAME
    if any(is_current(unit) for unit in units):
        return "current", "by its unit"
    if robot is not None and robot.effort in EFFORT_CONVENTIONS:
        # drivers write currents into the effort field; a column named torque is already converted
        if robot.effort == "commanded":
            return "commanded", f"as recorded by {robot.name}"
        if robot.effort == "current" and family.kind == "effort" and not any(units):
            return "current", f"as recorded by {robot.name}"
        if robot.effort == "measured":
            return "measured", f"as recorded by {robot.name}"
    if options.torque_convention == "gravity_compensated":
        return "commanded", "by `torque_convention`"
    return "measured", BY_DEFAULT


def _constants(
    options: UploadOptions, robot: Profile | None, known: Sequence[float] | None, n: int, commanded: str | None
) -> tuple[float, ...] | None:
    """Return the torque constants; None if they are to be estimated from the masses of the robot."""
    given = options.read.torque_constants
    if given is not None:
        if len(given) != n:
            raise _wrong_count("torque_constants", "torque constants", len(given), n)
        if not all(math.isfinite(value) and value != 0 for value in given):
            raise invalid_request("torque_constants", list(given), "finite numbers in N·m/A, none of them 0")
        return given
    if known is None or not all(math.isfinite(value) for value in known):
        if robot is not None:
            return None
        instead = "" if commanded is None else f", or {columns_hint({'tau': commanded})} to learn commanded torque"
        raise invalid_data(
            "torque_constants",
            "missing",
            f"{n} numbers in N·m/A, one per joint, because effort is motor current. Name the robot to estimate them "
            f"from the masses of its URDF. Set effort=measured if it is torque{instead}",
        )
    return tuple(float(value) for value in known)


def _wrong_count(option: str, what: str, count: int, n: int) -> InvalidRequestError:
    message = f"Expected {n} {what}, one per kept joint, got {count}."
    return invalid_request(option, f"{count} values", f"{n}, one per kept joint", message)


MOTION = ("dq", "ddq")
QUANTITY_NAMES = {"q": "positions", "dq": "velocities", "ddq": "accelerations", "tau": "torques"}
_MAX_LISTED = 6


@dataclass(frozen=True)
class Families:
    """The column families of a file.

    positions: family that defines the joints. given: families that the user named, by quantity.
    """

    names: Sequence[str]
    positions: Family
    others: tuple[Family, ...]
    given: dict[str, Family]
    options: UploadOptions

    def choose(self, joints: Sequence[Joint]) -> dict[str, Family]:
        """Return the family to read for each quantity; raise InvalidDataError if it is missing or not unique."""
        out = {"q": self.positions}
        for quantity in (*MOTION, "tau"):
            if (family := self._choose(quantity, joints)) is not None:
                out[quantity] = family
        for family in out.values():
            if self.positions.numbered and len(self.positions.members) == 1 < len(family.members):
                key = next(each for each in family.members if each not in self.positions.members)
                expected = f"positions of all joints because there are torques {family.pattern.replace(JOINT, '1')}…"
                raise invalid_data(f"column q{key}", "missing", expected)
            if family.repeated:
                raise invalid_data(
                    f"column {family.repeated[0] + 1}", self.names[family.repeated[0]], "each column only once"
                )
        return out

    def notes(self, chosen: dict[str, Family]) -> list[str]:
        """Return notes for the user on other columns that could be read instead."""
        out = []
        for quantity, family in chosen.items():
            others = [each.pattern for each in self.others if each.quantity == quantity and each is not family]
            if len(family.members) > 1 and (
                others := [each for each in others if JOINT in each and each != family.pattern]
            ):
                out.append(
                    f"{quantity} could also be read from {', '.join(others[:_MAX_LISTED])}, for example with "
                    f"{columns_hint({quantity: others[0]})}"
                )
        return out

    def commanded_pattern(self, joints: Sequence[Joint]) -> str | None:
        """Return the pattern of columns of commanded torque for these joints, if any."""
        rivals = (each for each in self.others if each.quantity == "tau" and effort_by_name(each) == "commanded")
        return next((each.pattern for each in rivals if covers(each, joints)), None)

    def _choose(self, quantity: str, joints: Sequence[Joint]) -> Family | None:
        if (given := self.given.get(quantity)) is not None:
            self._check_complete(given, joints)
            return given
        rivals = [each for each in self.others if each.quantity == quantity]
        if quantity in MOTION and self.positions.rank != Rank.COMMANDED:
            # commanded motion is not the measured motion
            rivals = [each for each in rivals if each.rank != Rank.COMMANDED]
        covering = [each for each in rivals if covers(each, joints)]
        if not covering:
            return self._check_missing(quantity, rivals, joints)
        if quantity == "tau":
            torques, covering = covering, prefer_effort(covering, self.options.read.effort)
            if not covering:
                listed = ", ".join(each.pattern for each in torques[:_MAX_LISTED])
                raise invalid_data(
                    "effort", self.options.read.effort, f"the effort that the name or unit of {listed} indicates"
                )
        best = best_ranked(covering)
        if quantity != "tau" and best[0].rank == Rank.CANONICAL:
            extra = [member for key, member in best[0].members.items() if key not in self.positions.members]
            if extra and self.positions.rank == Rank.CANONICAL:
                n, name = len(self.positions.members), self.names[extra[0].index]
                raise invalid_data(f"column {name}", "present", f"at most {quantity}{n} because there are q1..q{n}")
        if len(best) > 1:
            raise ambiguity_error(quantity, best)
        return best[0]

    def _check_missing(self, quantity: str, rivals: list[Family], joints: Sequence[Joint]) -> Family | None:
        parts = [each for each in rivals if 2 * sum(find_member(each, j) is not None for j in joints) >= len(joints)]
        if parts:
            self._check_complete(max(parts, key=lambda each: (-each.rank, len(each.members))), joints)
        if quantity in MOTION:
            return None
        key = joints[0].key if len(joints) == 1 and self.positions.numbered else 1
        expected = (
            f"tau1..tau{len(joints)} because there are q1..q{len(joints)}" if key == 1 else f"the torque of q{key}"
        )
        hint = columns_hint({"tau": "…{joint}…"})
        raise invalid_data(f"column tau{key}", "missing", f"{expected}. Set {hint} if they have other names")

    def _check_complete(self, family: Family, joints: Sequence[Joint]) -> None:
        for joint in joints:
            if find_member(family, joint) is not None:
                continue
            n, quantity = len(self.positions.members), family.quantity
            if family.rank == Rank.CANONICAL:
                name, expected = f"{quantity}{joint.key}", f"{quantity}1..{quantity}{n} because there are q1..q{n}"
            else:
                name = family.pattern.replace(JOINT, joint.label)
                expected = f"{QUANTITY_NAMES[quantity]} of every joint because there is {self.names[joint.index]}"
            raise invalid_data(
                f"column {name}", "missing", f"{expected}. Or leave out the joint with drop_joints={joint.name}"
            )


def choose_families(names: Sequence[str], options: UploadOptions) -> Families:
    """Sort a file's columns into families; raise InvalidDataError if positions are missing or not unique."""
    given = {
        quantity: _given_family(quantity, columns, names)
        for quantity, columns in options.read.columns.items()
        if quantity not in ("t", "episode")
    }
    others = tuple(find_families(names))
    if "q" in given:
        return Families(names, given["q"], others, given, options)
    rivals = [each for each in others if each.quantity == "q"]
    if not rivals:
        hint = columns_hint({"q": "…{joint}…"})
        expected = f"positions q1..qn. Set {hint} if they have other names"
        message = f"No joint positions were found, expected {expected}"
        raise invalid_data("columns", ", ".join(names[:200]), expected, message)
    best = best_ranked(rivals)
    if len(best) > 1:
        # only positions with torques can be of the robot
        torques = [each for each in (*others, *given.values()) if each.quantity == "tau"]
        with_torque = [each for each in best if any(covers(tau, list_joints(each)) for tau in torques)]
        best = with_torque or best
    if len(best) > 1:
        raise ambiguity_error("q", best)
    return Families(names, best[0], others, given, options)


def best_ranked(rivals: Sequence[Family]) -> list[Family]:
    """Return the families of the best rank; angles only if there are no positions."""
    order: Callable[[Family], tuple[int, bool]] = lambda each: (each.rank, each.kind == "angle")  # noqa: E731
    first = min(map(order, rivals))
    return [each for each in rivals if order(each) == first]


def ambiguity_error(quantity: str, rivals: Sequence[Family]) -> InvalidDataError:
    """Return the error for several families that could be a quantity."""
    listed = ", ".join(each.pattern for each in rivals[:_MAX_LISTED])
    hint = columns_hint({quantity: rivals[0].pattern})
    message = f"{quantity} could be read from {readable(listed)}. Choose one, for example with {hint}"
    return invalid_data(f"columns of {quantity}", listed, f"one of them, for example {hint}", message)


def find_member(family: Family, joint: Joint) -> Member | None:
    """Return a joint's column in a family, by name or number, or by position if only one of both has names."""
    if not family.listed and joint.key in family.members:
        return family.members[joint.key]
    by_place = family.listed or (family.numbered and isinstance(joint.key, str))
    if by_place and len(family.members) == joint.of:
        row = (
            list(family.members.values())
            if family.listed
            else [family.members[key] for key in sorted(family.members, key=int)]
        )
        return row[joint.place]
    return None


def member_of(family: Family, joint: Joint) -> Member:
    """Return a joint's column in a family; raise KeyError if there is none."""
    member = find_member(family, joint)
    if member is None:
        raise KeyError(joint.name)
    return member


def covers(family: Family, joints: Sequence[Joint]) -> bool:
    """Return whether a family has a column for each of the joints."""
    return all(find_member(family, joint) is not None for joint in joints)


def _given_family(quantity: str, columns: str | tuple[str, ...], names: Sequence[str]) -> Family:
    """Return the columns that a user names by a pattern or a list."""
    field = f"columns.{quantity}"
    if quantity not in QUANTITY_NAMES:
        listed = f"t, episode, {', '.join(QUANTITY_NAMES)}"
        message = f"{readable(field[:200])} is not a quantity. Quantities: {listed}"
        raise invalid_request(field, columns, f"one of the quantities {listed}", message)
    if isinstance(columns, str):
        if columns.count(JOINT) > 1:
            raise invalid_request(field, columns, f"{JOINT} only once")
        family = expand_pattern(columns, names, quantity)
        if not family.members:
            raise invalid_data(
                field, columns, f"a pattern that matches the file's columns: {', '.join(names[:_MAX_LISTED])}…"
            )
        return family
    out = Family(quantity, quantity, ", ".join(columns), Rank.MEASURED, listed=True)
    labels = [next((s.joint for s in interpret_name(each) if s.quantity == quantity), "") for each in columns]
    joint_keys = keys_of_joints(labels)
    distinct = len(set(joint_keys)) == len(joint_keys) and all(labels)
    for place, name in enumerate(columns):
        if name not in names:
            raise invalid_data(
                f"{field}[{place}]", name, f"one of the file's columns: {', '.join(names[:_MAX_LISTED])}…"
            )
        reading = next((s for s in interpret_name(name) if s.quantity == quantity), None)
        label = labels[place] if distinct else str(place + 1)
        out.members[joint_keys[place] if distinct else place + 1] = Member(
            names.index(name), label, reading.unit if reading else None
        )
        out.kind = reading.kind if reading else out.kind
    return out
