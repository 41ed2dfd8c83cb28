"""Which columns of a file become which of a data set, and in which order their joints come."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from lipcore.profiles import Profile
from service.datasets.mapping.choice import Torque, choose, source, source_or_none, torque
from service.datasets.mapping.joints import Joint, arrange
from service.datasets.mapping.recognition import Family, Rank, clocks, is_episode
from service.datasets.mapping.vocabulary import KNOWN, factor
from service.datasets.options import UploadOptions
from service.foundation.errors import invalid_data, invalid_request
from service.foundation.text import counted

LISTED = 8
"""Most columns that a sentence names."""


@dataclass(frozen=True)
class Source:
    """A column of the file: its index and name there, SI units in one of its unit; unit: as given, None for SI."""

    index: int
    name: str
    factor: float = 1.0
    unit: str | None = None


@dataclass(frozen=True)
class ColumnMap:
    """What to read. t: columns that add up to the time, none where there is no time; joints: names of those kept;
    places: theirs among all joints of the file.

    quantities: of q, tau, and of dq and ddq where there are any, one column a joint; dropped: of joints left out, by
    name, the column of their position; unused: names of all other columns; notes: what was understood, in sentences.
    """

    t: tuple[Source, ...]
    episode: Source | None
    joints: tuple[str, ...]
    places: tuple[int, ...]
    quantities: Mapping[str, tuple[Source, ...]]
    dropped: Mapping[str, Source]
    unused: tuple[str, ...]
    torque: Torque
    notes: tuple[str, ...]


def resolve(
    names: Sequence[str],
    units: Mapping[str, str],
    joint_names: tuple[str, ...] | None,
    options: UploadOptions,
    robot: Profile | None,
    max_joints: int,
) -> ColumnMap:
    """Find the columns; raise InvalidDataError that says what is missing or doubled, or how to tell what is unclear.

    units: of columns by name, where the file says them; joint_names: of joints 1..n, where it says them.
    """
    _check_options(names, options)
    families = choose(names, options)
    order = arrange(families.positions, joint_names, options, robot, max_joints)
    chosen = families.complete(order.kept)
    quantities = {
        quantity: tuple(_source(names, units, options, family, joint) for joint in order.kept)
        for quantity, family in chosen.items()
    }
    tau = chosen["tau"]
    tau_units = [each.unit for each in quantities["tau"]]
    meaning = torque(tau, tau_units, options, robot, order.constants, families.commanded(order.kept))
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
        raise invalid_data("columns", "the same for several quantities", "a column of its own for each")
    left_out = [source_or_none(family, joint) for family in chosen.values() for joint in order.dropped]
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
    member = source(family, joint)
    name, quantity = names[member.index], family.quantity
    unit = options.read.units.get(name) or options.read.units.get(quantity) or units.get(name) or member.unit
    return _scaled(member.index, name, quantity, unit)


def _scaled(index: int, name: str, quantity: str, unit: str | None) -> Source:
    if unit is None:
        return Source(index, name)
    scale = factor(quantity, unit)
    if scale is None:
        raise invalid_data(f"unit of {name}", unit, f'{KNOWN[quantity]}: say it, units={{"{quantity}": "…"}}')
    return Source(index, name, scale, unit)


def _time(names: Sequence[str], units: Mapping[str, str], options: UploadOptions) -> tuple[Source, ...]:
    given, unit = options.read.columns.get("t"), options.read.units.get("t")
    times = clocks(names)
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
            raise invalid_data("time", listed, f'one of them: columns={{"t": "{best[0].name}"}}')
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
            raise invalid_data(f"column {exact[1] + 1}", names[exact[1]], "every column once")
        raise invalid_data("episode", _listed(listed), f'one of them: columns={{"episode": "{listed[0]}"}}')
    return Source(exact[0], names[exact[0]]) if exact else None


def _single(quantity: str, given: str | tuple[str, ...], names: Sequence[str]) -> str:
    name = given if isinstance(given, str) else given[0] if len(given) == 1 else None
    if name not in names:
        raise invalid_data(f"columns.{quantity}", given, f"one of the file's columns: {_listed(names)}")
    return str(name)


def _check_options(names: Sequence[str], options: UploadOptions) -> None:
    for name, unit in options.read.units.items():
        if name in KNOWN and factor(name, unit) is None:
            raise invalid_request(f"units.{name}", unit, KNOWN[name])
        if name not in KNOWN and name not in names:
            raise invalid_request(f"units.{name}", unit, f"the unit of one of {', '.join(KNOWN)}, or of a column")


def _notes(
    chosen: Mapping[str, Family],
    quantities: Mapping[str, Sequence[Source]],
    times: Sequence[Source],
    episode: Source | None,
) -> list[str]:
    """Which columns were taken for what, where their names or units are not those that are documented."""
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
    rest = len(names) - LISTED
    return ", ".join(names[:LISTED]) + (f" and {rest} more" if rest > 0 else "")
