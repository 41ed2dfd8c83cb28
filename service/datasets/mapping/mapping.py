"""Mapping the columns of a file to those of a data set, and ordering the joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from lipcore.profiles import Profile
from service.datasets.mapping.choice import TorqueMeaning, choose_families, find_member, interpret_torque, member_of
from service.datasets.mapping.joints import Joint, arrange_joints
from service.datasets.mapping.recognition import Family, Rank, columns_hint, find_times, is_episode
from service.datasets.mapping.vocabulary import KNOWN_UNITS, unit_factor
from service.datasets.options import UploadOptions
from service.foundation.errors import InvalidDataError, invalid_data, invalid_request, readable
from service.foundation.text import counted

MAX_LISTED = 8
"""Max columns that a message lists."""


@dataclass(frozen=True)
class Source:
    """A column of the file."""

    index: int
    name: str
    factor: float = 1.0
    """Factor to SI."""
    unit: str | None = None
    """Unit as given; None for SI."""


@dataclass(frozen=True)
class ColumnMap:
    """The columns to read."""

    t: tuple[Source, ...]
    """Columns that add up to the time; empty if there is no time."""
    episode: Source | None
    joints: tuple[str, ...]
    """Names of the joints that are kept."""
    places: tuple[int, ...]
    """Their indices among all joints of the file."""
    quantities: Mapping[str, tuple[Source, ...]]
    """One column per joint for q and tau, and for dq and ddq if there are any."""
    dropped: Mapping[str, Source]
    """Column of the position by name of each joint that is left out."""
    unused: tuple[str, ...]
    """Names of all other columns."""
    torque: TorqueMeaning
    notes: tuple[str, ...]
    """Sentences for the report on how the columns are read."""


def map_columns(
    names: Sequence[str],
    units: Mapping[str, str],
    joint_names: tuple[str, ...] | None,
    options: UploadOptions,
    robot: Profile | None,
    max_joints: int,
) -> ColumnMap:
    """Find the columns to read; raise InvalidDataError if one is missing, repeated or ambiguous.

    units: by column name, if the file states them; joint_names: of joints 1..n, if the file states them.
    """
    _check_options(names, options)
    families = choose_families(names, options)
    order = arrange_joints(families.positions, joint_names, options, robot, max_joints)
    chosen = families.choose(order.kept)
    quantities = {
        quantity: tuple(_source(names, units, options, family, joint) for joint in order.kept)
        for quantity, family in chosen.items()
    }
    tau = chosen["tau"]
    tau_units = [each.unit for each in quantities["tau"]]
    meaning = interpret_torque(tau, tau_units, options, robot, order.constants, families.commanded_pattern(order.kept))
    for factors in (meaning.constants, meaning.factors):
        if factors is not None:
            quantities["tau"] = tuple(
                replace(each, factor=each.factor * by) for each, by in zip(quantities["tau"], factors, strict=True)
            )
    times, episode = _time(names, units, options), _episode(names, options)
    dropped = {each.name: _source(names, units, options, families.positions, each) for each in order.dropped}
    read = [*(each for row in quantities.values() for each in row), *times, *([episode] if episode else [])]
    used = {each.index for each in read}
    if len(used) < len(read):
        message = "A column is used for several quantities. Set `columns` so that each quantity has its own columns"
        raise invalid_data("columns", "the same for several quantities", "different columns for each", message)
    left_out = [find_member(family, joint) for family in chosen.values() for joint in order.dropped]
    used |= {each.index for each in left_out if each is not None}
    unused = tuple(name for index, name in enumerate(names) if index not in used)
    notes = [*order.notes, *_notes(chosen, quantities, times, episode), *families.notes(chosen), *meaning.notes]
    if unused:
        are = "is" if len(unused) == 1 else "are"
        notes.append(f"{counted(len(unused), 'column')} {are} not used: {_listed(unused)}")
    return ColumnMap(
        times,
        episode,
        tuple(joint.name for joint in order.kept),
        tuple(joint.place for joint in order.kept),
        quantities,
        dropped,
        unused,
        meaning,
        tuple(notes),
    )


def _source(
    names: Sequence[str], units: Mapping[str, str], options: UploadOptions, family: Family, joint: Joint
) -> Source:
    member = member_of(family, joint)
    name, quantity = names[member.index], family.quantity
    unit = options.read.units.get(name) or options.read.units.get(quantity) or units.get(name) or member.unit
    return _scaled(member.index, name, quantity, unit)


def _scaled(index: int, name: str, quantity: str, unit: str | None) -> Source:
    if unit is None:
        return Source(index, name)
    scale = unit_factor(quantity, unit)
    if scale is None:
        raise invalid_data(f"unit of {name}", unit, f'{KNOWN_UNITS[quantity]}. Set units={{"{quantity}": "…"}}')
    return Source(index, name, scale, unit)


def _time(names: Sequence[str], units: Mapping[str, str], options: UploadOptions) -> tuple[Source, ...]:
    given, unit = options.read.columns.get("t"), options.read.units.get("t")
    times = find_times(names)
    if given is not None:
        name = _single("t", given, names)
        parts: tuple[tuple[int, str | None], ...] = ((names.index(name), None),)
        parts = next((clock.parts for clock in times if clock.parts[0][0] == parts[0][0]), parts)
    elif not times:
        return ()
    else:
        best = [clock for clock in times if clock.rank == times[0].rank]
        if len(best) > 1:
            listed = _listed([clock.name for clock in best])
            raise _ambiguous("time", listed, "t", best[0].name)
        parts = best[0].parts
    return tuple(
        _scaled(
            i,
            names[i],
            "t",
            options.read.units.get(names[i]) or (unit if len(parts) == 1 else None) or own or units.get(names[i]),
        )
        for i, own in parts
    )


def _episode(names: Sequence[str], options: UploadOptions) -> Source | None:
    if (given := options.read.columns.get("episode")) is not None:
        name = _single("episode", given, names)
        return Source(names.index(name), name)
    indices = [index for index, name in enumerate(names) if is_episode(name)]
    exact = [index for index in indices if names[index] == "episode"] or indices
    if len(exact) > 1:
        listed = [names[index] for index in exact]
        if len(set(listed)) < len(listed):
            raise invalid_data(f"column {exact[1] + 1}", names[exact[1]], "each column only once")
        raise _ambiguous("episode", _listed(listed), "episode", listed[0])
    return Source(exact[0], names[exact[0]]) if exact else None


def _ambiguous(field: str, listed: str, quantity: str, name: str) -> InvalidDataError:
    hint = f"one of them, for example {columns_hint({quantity: name})}"
    message = f"The {field} could be read from {readable(listed[:200])}. Choose {hint}"
    return invalid_data(field, listed, hint, message)


def _single(quantity: str, given: str | tuple[str, ...], names: Sequence[str]) -> str:
    name = given if isinstance(given, str) else given[0] if len(given) == 1 else None
    if name not in names:
        raise invalid_data(f"columns.{quantity}", given, f"one of the file's columns: {_listed(names)}")
    return str(name)


def _check_options(names: Sequence[str], options: UploadOptions) -> None:
    for name, unit in options.read.units.items():
        if name in KNOWN_UNITS and unit_factor(name, unit) is None:
            raise invalid_request(f"units.{name}", unit, KNOWN_UNITS[name])
        if name not in KNOWN_UNITS and name not in names:
            field, expected = f"units.{name}", f"one of {', '.join(KNOWN_UNITS)} or a column of the file"
            raise invalid_request(field, unit, expected, f"{readable(field[:200])} is not {expected}")


def _notes(
    chosen: Mapping[str, Family],
    quantities: Mapping[str, Sequence[Source]],
    times: Sequence[Source],
    episode: Source | None,
) -> list[str]:
    """Return notes on columns that do not have the documented names or units."""
    out = []
    for quantity, row in quantities.items():
        if chosen[quantity].rank != Rank.CANONICAL:
            out.append(f"{quantity} is read from {chosen[quantity].pattern}")
        units = sorted({each.unit for each in row if each.unit is not None})
        if units and any(each.factor != 1.0 for each in row):
            out.append(f"{quantity} is converted from {', '.join(units)}")
    if times and (len(times) > 1 or times[0].name != "t" or times[0].factor != 1.0):
        units = [f" in {each.unit}" if each.unit else "" for each in times]
        out.append("t is read from " + " and ".join(e.name + s for e, s in zip(times, units, strict=True)))
    if episode is not None and episode.name != "episode":
        out.append(f"episode is read from {episode.name}")
    return out


def _listed(names: Sequence[str]) -> str:
    rest = len(names) - MAX_LISTED
    return ", ".join(names[:MAX_LISTED]) + (f" and {rest} more" if rest > 0 else "")
