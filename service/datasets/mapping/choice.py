"""Which families of columns are meant, where a file has several of a quantity; and what the effort of a recording is:
torque with or without gravity, or motor current that constants turn into it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from lipcore.profiles import Profile
from lipcore.vocabulary import TorqueConvention
from service.contract.uploads import Effort
from service.datasets.mapping.joints import Joint, order_of
from service.datasets.mapping.recognition import (
    JOINT,
    Family,
    Member,
    Rank,
    columns_hint,
    families,
    keys,
    sightings,
    unfold,
)
from service.datasets.mapping.vocabulary import factor, is_current
from service.datasets.options import EFFORT_CONVENTIONS, UploadOptions
from service.foundation.errors import InvalidDataError, invalid_data, invalid_request

MEANINGS: dict[Effort, str] = {
    "measured": "torque as measured, gravity included",
    "commanded": "torque as commanded, without what compensates gravity",
    "current": "motor current, A",
}

BY_DEFAULT, BY_NAME = "as nothing else is said", "as the columns are called"
WARNING = "warning: "
"""What a sentence begins with that belongs to the warnings of a report."""


@dataclass(frozen=True)
class Torque:
    """How the column of torque is taken. constants: N·m/A by joint, of motor currents; factors: of the torques."""

    effort: Effort
    convention: TorqueConvention
    constants: tuple[float, ...] | None
    factors: tuple[float, ...] | None
    notes: tuple[str, ...]


def named(family: Family) -> Effort:
    """What the names of columns say that they hold."""
    first = next(iter(family.members.values()), None)
    if family.kind == "current" or (first is not None and is_current(first.unit)):
        return "current"
    return "commanded" if family.rank == Rank.AIM else "measured"


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
    commanded: str | None = None,
) -> Torque:
    """Say what the chosen columns are; raise InvalidDataError where that contradicts itself.

    units: of the columns, as far as said; constants: of the robot's joints in the order of the columns; commanded:
    columns of commanded torque that could be read instead, where there are any.
    """
    effort, why = _effort(family, units, options, robot)
    notes = [f"{family.pattern} is taken as {MEANINGS[effort]}, {why}"]
    if why == BY_NAME and effort == "commanded":
        notes.append(
            f"{WARNING}{family.pattern} is what was commanded, and no column was taken for measured torque, which is "
            f"what a model should learn: name it with {columns_hint({'tau': '…{joint}…'})}, or say effort=commanded if "
            "that is meant"
        )
    if why == BY_DEFAULT and family.rank == Rank.CANONICAL:
        notes = []  # as documented
    wrong = next((unit for unit in units if unit is not None and is_current(unit) != (effort == "current")), None)
    if wrong is not None and effort != "current":
        raise invalid_data(f"unit of {family.pattern}", wrong, f"a torque, as effort is {effort}; or effort=current")
    if wrong is not None and factor("tau", wrong) not in (None, 1.0):
        raise invalid_data(f"unit of {family.pattern}", wrong, "A or mA, as effort is current")
    given: tuple[float, ...] | None = None
    if effort == "current":
        given = _constants(options, constants, len(units), commanded)
        notes.append(f"torque is current times {listed(given)} N·m/A of the joints")
    elif options.read.torque_constants is not None:
        raise invalid_request(
            "torque_constants",
            listed(options.read.torque_constants),
            f"nothing, as {family.pattern} is {MEANINGS[effort]}, {why}; or effort=current where it is motor current",
        )
    factors = options.read.torque_factors
    if factors is not None:
        if len(factors) != len(units):
            raise invalid_request("torque_factors", f"{len(factors)} values", f"{len(units)}, one a joint that is kept")
        notes.append(f"torque is multiplied by {listed(factors)} of the joints, as the upload asks for")
    convention = options.torque_convention or EFFORT_CONVENTIONS[effort]
    if convention != EFFORT_CONVENTIONS[effort]:
        notes.append(f"the torque convention is {convention}, as the upload says, though effort is {effort}")
    return Torque(effort, convention, given, factors, tuple(notes))


def listed(values: Sequence[float]) -> str:
    """Numbers as an option of the upload takes them, four digits each."""
    return ", ".join(f"{value:.4g}" for value in values)


def _effort(
    family: Family, units: Sequence[str | None], options: UploadOptions, robot: Profile | None
) -> tuple[Effort, str]:
    given = options.read.effort
    if given is not None:
        return given, "as the upload says"
    by_name = named(family)
    if by_name != "measured":
        return by_name, BY_NAME
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


def _constants(
    options: UploadOptions, known: Sequence[float] | None, n: int, commanded: str | None
) -> tuple[float, ...]:
    given = options.read.torque_constants
    if given is not None:
        if len(given) != n:
            raise invalid_request("torque_constants", f"{len(given)} values", f"{n}, one a joint that is kept")
        if not all(math.isfinite(value) and value != 0 for value in given):
            raise invalid_request("torque_constants", list(given), "finite numbers of N·m/A, none of them 0")
        return given
    if known is None or not all(math.isfinite(value) for value in known):
        instead = "" if commanded is None else f"; or {columns_hint({'tau': commanded})} to learn what was commanded"
        raise invalid_data(
            "torque_constants",
            "missing",
            f"{n} numbers of N·m/A, one a joint, as effort is motor current; or effort=measured where it is torque"
            f"{instead}",
        )
    return tuple(float(value) for value in known)


MOTION = ("dq", "ddq")
MEANT = {"q": "positions", "dq": "velocities", "ddq": "accelerations", "tau": "torques"}
_MOST_LISTED = 6


@dataclass(frozen=True)
class Families:
    """Families of columns. positions: those that say which joints there are; given: those that the user named."""

    names: Sequence[str]
    positions: Family
    others: tuple[Family, ...]
    given: dict[str, Family]
    options: UploadOptions

    def complete(self, joints: Sequence[Joint]) -> dict[str, Family]:
        """For each quantity the columns to read for these joints; raise InvalidDataError where that is not clear."""
        out = {"q": self.positions}
        for quantity in (*MOTION, "tau"):
            if (family := self._of(quantity, joints)) is not None:
                out[quantity] = family
        for family in out.values():
            if family.doubled:
                raise invalid_data(
                    f"column {family.doubled[0] + 1}", self.names[family.doubled[0]], "every column once"
                )
        return out

    def notes(self, chosen: dict[str, Family]) -> list[str]:
        """What else could have been read."""
        out = []
        for quantity, family in chosen.items():
            others = [each.pattern for each in self.others if each.quantity == quantity and each is not family]
            if len(family.members) > 1 and (
                others := [each for each in others if JOINT in each and each != family.pattern]
            ):
                out.append(
                    f"{quantity} could also be {', '.join(others[:_MOST_LISTED])}: "
                    f"{columns_hint({quantity: others[0]})} reads that instead"
                )
        return out

    def commanded(self, joints: Sequence[Joint]) -> str | None:
        """Columns of commanded torque, where there are any for these joints."""
        rivals = (each for each in self.others if each.quantity == "tau" and named(each) == "commanded")
        return next((each.pattern for each in rivals if covers(each, joints)), None)

    def _of(self, quantity: str, joints: Sequence[Joint]) -> Family | None:
        if (given := self.given.get(quantity)) is not None:
            self._check_complete(given, joints)
            return given
        rivals = [each for each in self.others if each.quantity == quantity]
        if quantity in MOTION and self.positions.rank != Rank.AIM:
            # what was aimed at is not how the robot moved
            rivals = [each for each in rivals if each.rank != Rank.AIM]
        covering = [each for each in rivals if covers(each, joints)]
        if not covering:
            return self._none_complete(quantity, rivals, joints)
        if quantity == "tau":
            torques, covering = covering, prefer(covering, self.options.read.effort)
            if not covering:
                listed = ", ".join(each.pattern for each in torques[:_MOST_LISTED])
                raise invalid_data("effort", self.options.read.effort, f"what {listed} holds by its name or unit")
        best = best_of(covering)
        if quantity != "tau" and best[0].rank == Rank.CANONICAL:
            extra = [member for key, member in best[0].members.items() if key not in self.positions.members]
            if extra and self.positions.rank == Rank.CANONICAL:
                n, name = len(self.positions.members), self.names[extra[0].index]
                raise invalid_data(f"column {name}", "present", f"at most {quantity}{n}, as there are q1..q{n}")
        if len(best) > 1:
            raise unclear(quantity, best)
        return best[0]

    def _none_complete(self, quantity: str, rivals: list[Family], joints: Sequence[Joint]) -> Family | None:
        parts = [each for each in rivals if 2 * sum(source_or_none(each, j) is not None for j in joints) >= len(joints)]
        if parts:
            self._check_complete(max(parts, key=lambda each: (-each.rank, len(each.members))), joints)
        if quantity in MOTION:
            return None
        expected = f"tau1..tau{len(joints)}, as there are q1..q{len(joints)}"
        raise invalid_data(
            "column tau1", "missing", f"{expected}; or {columns_hint({'tau': '…{joint}…'})} if called otherwise"
        )

    def _check_complete(self, family: Family, joints: Sequence[Joint]) -> None:
        for joint in joints:
            if source_or_none(family, joint) is not None:
                continue
            n, quantity = len(self.positions.members), family.quantity
            if family.rank == Rank.CANONICAL:
                name, expected = f"{quantity}{joint.key}", f"{quantity}1..{quantity}{n}, as there are q1..q{n}"
            else:
                name = family.pattern.replace(JOINT, joint.label)
                expected = f"{MEANT[quantity]} of every joint, as there is {self.names[joint.index]}"
            raise invalid_data(
                f"column {name}", "missing", f"{expected}; or leave the joint out, drop_joints={joint.name}"
            )


def choose(names: Sequence[str], options: UploadOptions) -> Families:
    """Sort a file's columns; raise InvalidDataError without positions, or where several could be them."""
    given = {
        quantity: _given(quantity, named, names)
        for quantity, named in options.read.columns.items()
        if quantity not in ("t", "episode")
    }
    others = tuple(families(names))
    if "q" in given:
        return Families(names, given["q"], others, given, options)
    rivals = [each for each in others if each.quantity == "q"]
    if not rivals:
        hint = columns_hint({"q": "…{joint}…"})
        raise invalid_data("columns", ", ".join(names[:200]), f"positions q1..qn; or {hint} if called otherwise")
    best = best_of(rivals)
    if len(best) > 1:
        # positions without torques are those of something else
        torques = [each for each in (*others, *given.values()) if each.quantity == "tau"]
        with_torque = [each for each in best if any(covers(tau, order_of(each)) for tau in torques)]
        best = with_torque or best
    if len(best) > 1:
        raise unclear("q", best)
    return Families(names, best[0], others, given, options)


def best_of(rivals: Sequence[Family]) -> list[Family]:
    """Those of the best rank; an angle only where nothing is called a position."""
    order: Callable[[Family], tuple[int, bool]] = lambda each: (each.rank, each.kind == "angle")  # noqa: E731
    first = min(map(order, rivals))
    return [each for each in rivals if order(each) == first]


def unclear(quantity: str, rivals: Sequence[Family]) -> InvalidDataError:
    """The error where several families could be a quantity."""
    listed = ", ".join(each.pattern for each in rivals[:_MOST_LISTED])
    hint = columns_hint({quantity: rivals[0].pattern})
    return invalid_data(f"columns of {quantity}", listed, f"one of them: say which, such as {hint}")


def source_or_none(family: Family, joint: Joint) -> Member | None:
    """A joint's column of a family: by its name or number; by its place where only one of both has names."""
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


def source(family: Family, joint: Joint) -> Member:
    """A joint's column of a family that has one; raise KeyError otherwise."""
    member = source_or_none(family, joint)
    if member is None:
        raise KeyError(joint.name)
    return member


def covers(family: Family, joints: Sequence[Joint]) -> bool:
    """Whether a family has a column for each of the joints."""
    return all(source_or_none(family, joint) is not None for joint in joints)


def _given(quantity: str, columns: str | tuple[str, ...], names: Sequence[str]) -> Family:
    """The columns that a user names: by a pattern, or one by one."""
    field = f"columns.{quantity}"
    if quantity not in MEANT:
        raise invalid_request(field, columns, f"one of t, episode, {', '.join(MEANT)}")
    if isinstance(columns, str):
        if columns.count(JOINT) > 1:
            raise invalid_request(field, columns, f"{JOINT} once")
        family = unfold(columns, names, quantity)
        if not family.members:
            raise invalid_data(field, columns, f"a pattern of the file's columns: {', '.join(names[:_MOST_LISTED])}…")
        return family
    out = Family(quantity, quantity, ", ".join(columns), Rank.MEASURED, listed=True)
    labels = [next((s.joint for s in sightings(each) if s.quantity == quantity), "") for each in columns]
    joint_keys = keys(labels)
    distinct = len(set(joint_keys)) == len(joint_keys) and all(labels)
    for place, name in enumerate(columns):
        if name not in names:
            raise invalid_data(
                f"{field}[{place}]", name, f"one of the file's columns: {', '.join(names[:_MOST_LISTED])}…"
            )
        seen = next((s for s in sightings(name) if s.quantity == quantity), None)
        label = labels[place] if distinct else str(place + 1)
        out.members[joint_keys[place] if distinct else place + 1] = Member(
            names.index(name), label, seen.unit if seen else None
        )
        out.kind = seen.kind if seen else out.kind
    return out
