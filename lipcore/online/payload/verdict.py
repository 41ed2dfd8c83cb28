"""What the evidence of the last cells is enough for: a payload, a contact, other friction, or nothing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lipcore.data.samples import Array
from lipcore.online.payload.hypotheses import Kind, Window
from lipcore.robots.urdf import PARAMETERS
from lipcore.vocabulary import PayloadState


@dataclass(frozen=True)
class VerdictOptions:
    """Evidence that names a payload or a contact.

    In 60 s each of slow and of fast motion of the dirty Panda of seed 50 a payload that was not there explained up to
    28 nats, and at most 2 at a time.
    """

    sure_nats: float = 20.0
    better_nats: float = 5.0
    """Nats by which a payload explains the last cells better than nothing, and than a contact, to be taken for one at
    once."""
    certain_nats: float = 60.0
    alike_share: float = 0.99
    """What is so certain is taken for a payload if that explains so large a share of what a contact does: the torques
    of a contact are any, and those of a payload as good as the arm's geometry."""
    lasting_cells: int = 6
    lasting_share: float = 0.8
    """What lasts for so many cells, 0.3 s, is no knock, and needs a smaller share; twice as long, its square."""
    at_once_nats: float = 3000.0
    precise: float = 0.1
    """Nats from which on a payload is taken for one before it lasts, and the deviation of the logarithm of its mass
    then: a push that looks like a body to within some tenths of its torque is no rare chance, to within hundredths it
    is."""
    likely_nats: float = 10.0
    """Nats from which on a contact is named. Cells that are as far off as `sure_nats` teach nothing of the payload."""
    positive: float = 1.5
    """Standard deviations by which the mass of a payload that is taken up lies above zero."""
    another_nats: float = 200.0
    """Nats by which another payload has to explain more than the carried one, of which rows go on telling more."""


VERDICT = VerdictOptions()
PRIOR: Mapping[Kind, float] = {"payload": -12.0, "contact": -7.0, "friction": -16.0}
"""Logarithm of how probable each is to begin within a cell: a contact once a minute, a payload once in two hours, other
friction all at once in days."""
Gains = Mapping[int, Mapping[Kind, float]]


def taken(window: Window, gains: Gains, carried: Array | None = None, every: int = 1) -> int | None:
    """For how many cells something has been carried, or something else; None where that does not show. carried: the
    parameters of what is carried as far as is known, (10,); every: of how many cells the window has one."""
    after = max(gains, key=lambda each: gains[each]["payload"])
    contact = gains[after]["contact"]
    best = gains[after]["payload"]
    # at once, the rows decide with the arm's geometry as they have it; see `Watch._take_up`
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
        if mass < VERDICT.positive * std:  # something is gone that the arm was trained with, or that was not noticed
            return None
    real = window.of_body(after, np.zeros(PARAMETERS) if carried is None else carried)
    return after if shows(real) and min(best, real) - window.past_contact() >= VERDICT.better_nats else None


def state_of(gains: Gains) -> PayloadState:
    """What is named where no payload is taken up or put down."""
    best = {kind: max(each[kind] for each in gains.values()) for kind in PRIOR}
    if max(best["contact"], best["friction"]) <= VERDICT.likely_nats:
        return "none"
    return "contact" if best["contact"] + PRIOR["contact"] >= best["friction"] + PRIOR["friction"] else "friction"


def probabilities(gains: Gains) -> dict[str, float]:
    """Of nothing new, and of each hypothesis to hold for one of the numbers of cells."""
    logs: dict[str, float] = {"none": 0.0}
    for kind, prior in PRIOR.items():
        logs[kind] = prior + float(np.logaddexp.reduce([each[kind] for each in gains.values()]))
    values = np.array(list(logs.values()))
    share = np.exp(values - np.logaddexp.reduce(values))
    return dict(zip(logs, share.tolist(), strict=True))
