"""How well a learning model predicts: every row is predicted before it is learnt, and compared with what came."""

from __future__ import annotations

import time

from lipcore.online.record import Record
from lipcore.vocabulary import CODES, LEARNT
from service.learning.control.schema import Figures, Quality, QualityWindow
from service.learning.quality.windows import Window
from service.learning.updates import Updates

SHOWN = ("nmse", "rmse", "coverage", "nlpd")


def show(updates: Updates, model: str) -> Quality:
    """Return the quality of a model over the windows of the settings; raise NotFoundError. Not for the event loop."""
    served = updates.loaded.get(model, None)
    now = time.time()
    return Quality(
        model=model,
        version=served.version,
        revision=served.revision,
        joint_names=list(served.model.joint_names),
        windows=[window(each, now) for each in updates.monitor(model).windows],
    )


def window(seen: Window, now: float) -> QualityWindow:
    """Return what came within a window before a Unix time, s."""
    counts = seen.counts(now)
    accepted = counts.pop(CODES[LEARNT], 0)
    return QualityWindow(
        **figures(seen.record(now)).model_dump(), seconds=seen.seconds, accepted=accepted, rejected=dict(counts)
    )


def figures(record: Record) -> Figures:
    """Return what a record says, per joint."""
    known = record.metrics()
    return Figures(rows=record.rows, **{name: known[name] for name in SHOWN})
