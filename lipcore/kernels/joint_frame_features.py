"""The features of an arm's torque, number by number: its derivatives with respect to bodies and geometry.

`joint_frames.torque` is traced with unknown changes of each link's body and frame, and differentiated. Of the ten
parameters of a body, torque depends on seven or fewer: those of masses on the joint's axis belong to the link before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lipcore.data.samples import Array
from lipcore.kernels.geometry import Geometry
from lipcore.kernels.graph import Number, jacobian
from lipcore.kernels.joint_frames import ROUNDING, Link, links_of, torque

REVOLUTE = ((0, 3), (1, 3), (0, 0), (1, 1), (0, 1), (0, 2), (1, 2))
"""Entries of a body that move the torques of its own joint and the joints before: see `Link.body`."""
PRISMATIC = ((0, 3), (1, 3), (2, 3), (3, 3))

Features = list[list[Number]]
"""The derivative of each torque with respect to each of b numbers, (n, b)."""


def features(
    geometry: Geometry, bodies: Array, is_learnt: bool, q: Any, dq: Any, ddq: Any, turn: Any, more: Any
) -> tuple[Features, Array, list[int]]:
    """Return φ, (n, b), and T, (10 n + g, b), so that the change Y δπ + J δθ of torque is φ Tᵀ (δπ, δθ).

    The third is the first of the b numbers that torque of each joint depends on: they are those of bodies, from base to
    tip, then of the geometry. is_learnt: whether the geometry changes; otherwise g is zero. For the other arguments see
    `joint_frames.torque`; all are numbers of one graph.
    """
    links = links_of(geometry, np.zeros(0), bodies, np.zeros_like(bodies))
    entries = [(j, *each) for j, link in enumerate(links) for each in (PRISMATIC if link.slides else REVOLUTE)]
    moved = [j for j, count in enumerate(geometry.screws if is_learnt else ()) for _ in range(count)]
    steps = [links_of(geometry, each, bodies, np.zeros_like(bodies)) for each in np.eye(len(moved))]
    units = np.eye(bodies.size).reshape(-1, *bodies.shape)
    changes = [*(links_of(geometry, np.zeros(0), bodies, each) for each in units), *steps]
    expand = np.zeros((len(changes), len(entries) + len(moved)))
    expand[:, : len(entries)] = [[each[j].body[1][row, column] for j, row, column in entries] for each in changes]
    expand[len(units) :, len(entries) :] = np.eye(len(moved))
    symbols = q[0].graph.inputs(expand.shape[1])
    torques = torque(_with_changes(links, entries, moved, steps, symbols), q, dq, ddq, turn, more)
    return _distinct(jacobian([each.change for each in torques], symbols), expand)


def _with_changes(
    links: Sequence[Link],
    entries: Sequence[tuple[int, int, int]],
    moved: Sequence[int],
    steps: Sequence[Sequence[Link]],
    symbols: Sequence[Number],
) -> tuple[Link, ...]:
    """Return the links with unknown changes: symbols of the entries of bodies, then of the geometry.

    moved: joint of each number of the geometry; steps: the links after a unit step of this number.
    """
    bodies: Any = [np.zeros((4, 4), object) for _ in links]
    tilts, places = ([np.zeros(size, object) for _ in links] for size in (2, 3))
    for (j, row, column), symbol in zip(entries, symbols[: len(entries)], strict=True):
        bodies[j][row, column] = bodies[j][column, row] = symbol
    for j, step, symbol in zip(moved, steps, symbols[len(entries) :], strict=True):
        tilts[j] = tilts[j] + _rounded(step[j].tilt) * symbol
        places[j] = places[j] + _rounded(step[j].place[1]) * symbol
    return tuple(
        replace(link, tilt=tilt, place=(link.place[0], place), body=(link.body[0], body))
        for link, tilt, place, body in zip(links, tilts, places, bodies, strict=True)
    )


def _rounded(change: Array) -> Array:
    """Return a change with a unit step, without rounding errors of zero."""
    return np.where(np.abs(change) < ROUNDING, 0.0, change)


def _distinct(derivatives: Features, expand: Array) -> tuple[Features, Array, list[int]]:
    """Return the features without those that are zero, and with equal ones added up."""
    places: dict[tuple[int, ...], int] = {}
    kept, columns = list[list[Number]](), list[Array]()
    for number, column in enumerate(zip(*derivatives, strict=True)):
        key = tuple(each.place for each in column)
        if all(each.constant == 0.0 for each in column):
            continue
        if key in places:
            columns[places[key]] = columns[places[key]] + expand[:, number]
        else:
            places[key] = len(kept)
            kept.append(list(column))
            columns.append(expand[:, number])
    rows = [list(row) for row in zip(*kept, strict=True)]
    first = [next(c for c, each in enumerate(row) if each.constant != 0.0) for row in rows]
    return rows, np.stack(columns, axis=1), first
