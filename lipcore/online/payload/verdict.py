"""What the evidence of the last cells is enough for: a payload, a contact, other friction, or nothing."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lipcore.data.samples import Array
from lipcore.online.payload.hypotheses import Kind, Window
from lipcore.robots.urdf import PARAMETERS
from lipcore.vocabulary import PayloadState

SURE, BETTER = 20.0, 5.0
"""Nats by which a payload explains the last cells better than nothing, and than a contact, to be taken for one at once.
In 60 s each of slow and of fast motion of the dirty Panda of seed 50 there were up to 28 and at most 2 at a time."""
CERTAIN, ALIKE = 60.0, 0.99
"""What is so certain is taken for a payload where that explains so large a share of what a contact does: the torques of
a contact are any, and those of a payload as good as the arm's geometry."""
LASTING, NEARLY = 6, 0.8
"""What lasts for so many cells, 0.3 s, is no knock any more, and needs a smaller share; twice as long, its square."""
AT_ONCE, PRECISE = 3000.0, 0.1
"""Nats from which on a payload is taken for one before it lasts, and the deviation of the logarithm of its mass then: a
push that looks like a body to within some tenths of its torque is no rare chance, to within hundredths it is."""
LIKELY = 10.0
"""Nats from which on a contact is named. Cells that are as far off as SURE teach nothing of the payload."""
POSITIVE, ANOTHER = 1.5, 200.0
"""Standard deviations above zero that the mass of a payload lies that is taken up; nats by which another payload has to
explain more than the one that is carried, of which rows go on telling more. Both as SURE."""
PRIOR: Mapping[Kind, float] = {"payload": -12.0, "contact": -7.0, "friction": -16.0}
"""Logarithm of how probable each is to begin within a cell: a contact once a minute, a payload once in two hours, other
friction all at once in days."""
Gains = Mapping[int, Mapping[Kind, float]]
KINDS: tuple[Kind, ...] = ("payload", "contact", "friction")


def taken(window: Window, gains: Gains, carried: Array | None = None, every: int = 1) -> int | None:
    """For how many cells something has been carried, or something else; None where that does not show. carried: the
    parameters of what is carried as far as is known, (10,); every: of how many cells the window has one."""
    after = max(gains, key=lambda each: gains[each]["payload"])
    contact = gains[after]["contact"]
    best = gains[after]["payload"]
    # at once, the rows decide with the arm's geometry as they have it; see `Watch._take_up`
    near = after >= LASTING or (carried is None and best >= AT_ONCE)
    share = NEARLY**every if near and after < len(window.cells) else ALIKE
    sure, certain = (SURE, CERTAIN) if carried is None else (ANOTHER, ANOTHER)

    def shows(payload: float) -> bool:
        return (payload >= sure and payload - contact >= BETTER) or (payload >= certain and payload >= share * contact)

    if not shows(best) or (after < LASTING and (best < AT_ONCE or every > 1)):
        return None
    if carried is None:
        mass, std = window.mass(after)
        if mass < POSITIVE * std:  # something is gone that the arm was trained with, or that was not noticed
            return None
    real = window.of_body(after, np.zeros(PARAMETERS) if carried is None else carried)
    return after if shows(real) and min(best, real) - window.past_contact() >= BETTER else None


def state_of(gains: Gains) -> PayloadState:
    """What is named where no payload is taken up or put down."""
    best = {kind: max(each[kind] for each in gains.values()) for kind in KINDS}
    if max(best["contact"], best["friction"]) <= LIKELY:
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
