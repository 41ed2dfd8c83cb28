"""The terms of a joint's drive, friction and gain, one coefficient each.

With the position q, the velocity v, its smoothed sign s = tanh(v / w), and the torque τ that the bodies need at this
joint:

    viscous   v
    coulomb   s
    offset    1
    stribeck  s exp(−(v / 0.1)²)                                             friction falls with speed
    speed     tanh(v / 0.1), tanh(v / 0.4), tanh(v / 1.5), v |v|             it is not linear in speed
    sides     |s|, |v|                                                       it differs between the directions
    position  sin q, cos q, sin 2q, … cos 4q                                 it repeats over a turn
    load      |τ| s, |τ| v                                                   it grows with the torque carried
    gain      τ                                                              torque reads too high or too low
    play      e₁ … e_K                                                       it remembers where the joint came from

The deflections e of the play elements are those of `lipcore.kernels.drive.play`.
Every drive has the first three. The others are kinds that a recording has to support (`lipcore.arm.drive`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import cast

import numpy as np
from array_api_compat import array_namespace

from lipcore.data.motion import Array
from lipcore.kernels.drive.play import ELEMENTS
from lipcore.kernels.fast.drive import HARMONICS
from lipcore.vocabulary import DRIVE_KINDS, DriveKind

SIGN_WIDTH = 0.02
"""Velocity w over which the Coulomb sign changes, rad/s (m/s): the smoothed sign avoids a jump at standstill."""
STRIBECK_SPEED = 0.1
"""Speed at which the additional friction of slow joints has decayed to exp(−1), rad/s (m/s)."""
SHAPE_SPEEDS = (0.1, 0.4, 1.5)
"""Speeds of the shapes tanh(v / speed), rad/s (m/s)."""
SUMMARY_SPEEDS = (0.1, 1.0)
"""Speeds between which a report states friction as a line, rad/s (m/s)."""
MAX_GAIN_STD = 0.1
"""Max prior standard deviation of a gain: that of nominal torque constants. Torque sensors are better."""
BASE_TERMS = ("viscous", "coulomb", "offset")
WAVES = range(1, HARMONICS + 1)
"""Periods a turn of torque that repeats over a turn, as of cables, torque sensors and gears."""
KIND_TERMS: dict[DriveKind, tuple[str, ...]] = {
    "stribeck": ("stribeck",),
    "speed": ("speed_slow", "speed_medium", "speed_fast", "speed_square"),
    "sides": ("side", "side_viscous"),
    "position": tuple(f"{each}_{number}" for number in WAVES for each in ("sin", "cos")),
    "load": ("load", "load_viscous"),
    "gain": ("gain",),
    "play": tuple(f"play_{number}" for number in range(1, len(ELEMENTS) + 1)),
}


def check_kinds(kinds: Iterable[str]) -> tuple[DriveKind, ...]:
    """Return kinds in their usual order, each once; raise ValueError naming the first one that is unknown."""
    given = list(kinds)
    for kind in given:
        if kind not in DRIVE_KINDS:
            raise ValueError(f"drive kind is {kind!r}, expected one of {', '.join(DRIVE_KINDS)}")
    return cast("tuple[DriveKind, ...]", tuple(kind for kind in DRIVE_KINDS if kind in given))


def drive_terms(kinds: Sequence[DriveKind] = ()) -> tuple[str, ...]:
    """Return the names of a joint's terms."""
    return (*BASE_TERMS, *(term for kind in kinds for term in KIND_TERMS[kind]))


def drive_features(
    dq: Array,
    kinds: Sequence[DriveKind] = (),
    q: Array | None = None,
    load: Array | None = None,
    deflections: Array | None = None,
) -> Array:
    """Return the terms of N velocities, (f, N, n), in the array API.

    dq: (N, n) rad/s (m/s); q: (N, n) rad (m), for the kind `position`; load: (N, n) N·m (N), the torque that the bodies
    need, for the kinds `load` and `gain`; deflections: (N, K, n), expected ones, for the kind `play`.
    """
    xp = array_namespace(dq)
    sign, speed = xp.tanh(dq / SIGN_WIDTH), xp.abs(dq)
    parts = [dq, sign, xp.ones_like(dq)]
    if "stribeck" in kinds:
        parts.append(sign * xp.exp(-((dq / STRIBECK_SPEED) ** 2)))
    if "speed" in kinds:
        parts += [*(xp.tanh(dq / each) for each in SHAPE_SPEEDS), dq * speed]
    if "sides" in kinds:
        parts += [xp.abs(sign), speed]
    if "position" in kinds:
        assert q is not None  # the caller has it
        parts += [turn(number * q) for number in WAVES for turn in (xp.sin, xp.cos)]
    if "load" in kinds:
        assert load is not None  # the caller computes it
        parts += [xp.abs(load) * sign, xp.abs(load) * dq]
    if "gain" in kinds:
        assert load is not None
        parts.append(load)
    if "play" in kinds:
        assert deflections is not None  # the caller computes them
        parts += [deflections[:, k] for k in range(deflections.shape[1])]
    return xp.stack(parts)


def passing_row(kinds: Sequence[DriveKind]) -> Array:
    """Return the row, (f,), of a joint's Coulomb friction without the play elements: it remembers nothing."""
    row = summary_rows([kind for kind in kinds if kind != "play"])["coulomb"]
    return np.pad(row, (0, len(drive_terms(kinds)) - len(row)))


def summary_rows(kinds: Sequence[DriveKind]) -> dict[str, Array]:
    """Return the row, (f,), that turns a joint's coefficients into each number of a report.

    `viscous`, `coulomb`, `offset`, and `stribeck`, `load` and `gain` if they are modelled. `coulomb` includes the play
    elements, which have slipped in steady motion. With `speed` or `sides`, several terms are similar. `viscous` is then
    the slope of friction from SUMMARY_SPEEDS[0] to SUMMARY_SPEEDS[1], `coulomb` the friction that this line has at
    standstill, and `offset` the mean of both directions at the lower speed.
    """
    terms = drive_terms(kinds)
    rows = {
        name: np.array([float(term == name) for term in terms]) for name in (*BASE_TERMS, "stribeck", "load", "gain")
    }
    rows = {name: row for name, row in rows.items() if row.any()}
    slipped = np.array([float(term in KIND_TERMS["play"]) for term in terms])
    if not {"speed", "sides"} & set(kinds):
        return {**rows, "coulomb": rows["coulomb"] + slipped}
    low, high = SUMMARY_SPEEDS
    left_out = ("stribeck", *KIND_TERMS["position"], *KIND_TERMS["load"], "gain")
    counted = np.array([term not in left_out for term in terms])
    speeds, still, zero = np.array([[low], [high]]), np.zeros((2, len(ELEMENTS), 1)), np.zeros((2, 1))
    ahead, back = (
        drive_features(each, kinds, zero, zero, still + np.sign(each[0]))[:, :, 0] * counted[:, None]
        for each in (speeds, -speeds)
    )
    odd = 0.5 * (ahead - back)
    viscous = (odd[:, 1] - odd[:, 0]) / (high - low)
    offset = 0.5 * (ahead[:, 0] + back[:, 0])
    return {**rows, "viscous": viscous, "coulomb": odd[:, 0] - low * viscous, "offset": offset}
