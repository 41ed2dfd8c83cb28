"""Decide by the evidence of the last cells: a payload, a contact, changed friction, or nothing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lipcore.data.samples import Array
from lipcore.online.payload.hypotheses import CellWindow, Kind
from lipcore.robots.urdf import PARAMETERS
from lipcore.vocabulary import PayloadState


@dataclass(frozen=True)
class VerdictOptions:
    """Evidence required for a payload or a contact.

    Measured in 60 s each of slow and of fast motion of the dirty Panda of seed 50: a payload that was not there
    explained up to 28 nats, and at most 2 at a time.
    """

    sure_nats: float = 20.0
    better_nats: float = 5.0
    """Nats by which a payload must explain the last cells better than nothing, and better than a contact, to be
    accepted at once."""
    certain_nats: float = 60.0
    alike_share: float = 0.99
    """Above `certain_nats`, a payload must explain at least this share of what a contact explains. A contact may have
    any torques; those of a payload are only as exact as the arm's geometry."""
    lasting_cells: int = 6
    lasting_share: float = 0.8
    """An event that lasts `lasting_cells`, 0.3 s, is not a knock: the share `lasting_share` suffices. After twice that
    time, the square of this share suffices."""
    at_once_nats: float = 3000.0
    precise: float = 0.1
    """Min nats of a payload before it lasts, and the max standard deviation of its log mass then. An external torque
    often looks like a body to within some tenths of the torque, but rarely to within hundredths."""
    likely_nats: float = 10.0
    """Min nats of a reported contact. Cells further off than `sure_nats` are not used to estimate the payload."""
    positive: float = 1.5
    """Min mass of a payload that is picked up, in its standard deviations."""
    another_nats: float = 200.0
    """Nats by which another payload must explain the cells better than the current one, whose estimate still
    improves."""


VERDICT = VerdictOptions()
PRIOR: Mapping[Kind, float] = {"payload": -12.0, "contact": -7.0, "friction": -16.0}
"""Log probability that each begins within a cell: a contact once a minute, a payload once in two hours, a sudden change
of friction once in days."""
Gains = Mapping[int, Mapping[Kind, float]]


def find_pickup(window: CellWindow, gains: Gains, carried: Array | None = None, every: int = 1) -> int | None:
    """Return the number of cells since the arm picked up a new payload; None if the cells show none.

    carried: parameters of the known payload, (10,); every: the window contains one in `every` cells.
    """
    after = max(gains, key=lambda each: gains[each]["payload"])
    contact = gains[after]["contact"]
    best = gains[after]["payload"]
    # few rows suffice here, because `PayloadTracker._pick_up` checks them with the arm's geometry
    near = after >= VERDICT.lasting_cells or (carried is None and best >= VERDICT.at_once_nats)
    share = VERDICT.lasting_share**every if near and after < len(window.cells) else VERDICT.alike_share
    sure, certain = (
        (VERDICT.sure_nats, VERDICT.certain_nats) if carried is None else (VERDICT.another_nats, VERDICT.another_nats)
    )

    def shows(payload: float) -> bool:
        return (payload >= sure and payload - contact >= VERDICT.better_nats) or (
            payload >= certain and payload >= share * contact
        )

    if not shows(best) or (after < VERDICT.lasting_cells and (best < VERDICT.at_once_nats or every > 1)):
        return None
    if carried is None:
        mass, std = window.mass(after)
        if mass < VERDICT.positive * std:  # a mass was removed: one of the training, or one not detected
            return None
    real = window.of_body(after, np.zeros(PARAMETERS) if carried is None else carried)
    return after if shows(real) and min(best, real) - window.past_contact() >= VERDICT.better_nats else None


def classify_state(gains: Gains) -> PayloadState:
    """Return the state if no payload is picked up or put down."""
    best = {kind: max(each[kind] for each in gains.values()) for kind in PRIOR}
    if max(best["contact"], best["friction"]) <= VERDICT.likely_nats:
        return "none"
    return "contact" if best["contact"] + PRIOR["contact"] >= best["friction"] + PRIOR["friction"] else "friction"


def probabilities(gains: Gains) -> dict[str, float]:
    """Return the probability of nothing new, and of each hypothesis for any number of cells."""
    logs: dict[str, float] = {"none": 0.0}
    for kind, prior in PRIOR.items():
        logs[kind] = prior + float(np.logaddexp.reduce([each[kind] for each in gains.values()]))
    values = np.array(list(logs.values()))
    share = np.exp(values - np.logaddexp.reduce(values))
    return dict(zip(logs, share.tolist(), strict=True))
