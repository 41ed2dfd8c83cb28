"""The consequences of a batch that does not fit: alarms, a pause, unlearning of its stream."""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.orm import Session

from lipcore.online.judging import Judgement
from service.contract.observations import LearningOptions
from service.journal import undo
from service.journal.alarms import raise_alarm
from service.learning import owner, texts
from service.models.loaded import ServedModel
from service.storage import audit
from service.storage.database import EventRow


def apply_judgement(
    session: Session, served: ServedModel, options: LearningOptions, judgement: Judgement, event: EventRow
) -> None:
    """Raise the alarm of a change, pause learning, and unlearn a stream that does not fit, as a judgement demands."""
    if judgement.opened is not None and judgement.logged.held:
        _unlearn_stream(session, event)
    if judgement.change is not None:
        _alarm(session, served, "waits" if judgement.logged.waited else options.on_change, judgement, event)


def _unlearn_stream(session: Session, event: EventRow) -> None:
    """Unlearn the earlier batches of a stream, after its opening was found not to fit."""
    earlier = select(EventRow).where(
        EventRow.model == event.model,
        EventRow.stream_id == event.stream_id,
        EventRow.kind == "batch",
        EventRow.number < event.number,
        EventRow.void.is_(False),
    )
    for each in session.scalars(earlier.order_by(EventRow.number)).all():
        undo.unlearn(session, event.model, each, event.received)


def raise_clock_alarm(session: Session, model: str, stream_id: str, leap: float) -> None:
    """Raise the alarm of a stream with a clock ahead of its rows' arrival."""
    evidence = {"stream_id": stream_id, "ahead_s": leap}
    raise_alarm(session, model, "clock", texts.describe_clock(stream_id, leap), evidence)


def _alarm(session: Session, served: ServedModel, follows: str, judgement: Judgement, event: EventRow) -> None:
    """Raise the alarm of a change, and pause learning if `follows`, a key of `texts.CONSEQUENCES`, is "hold"."""
    change, names = judgement.change, served.model.joint_names
    assert change is not None
    evidence = judgement.evidence(names) | {"stream_id": event.stream_id, "sequence": event.sequence}
    joints = ", ".join(names[joint] for joint in change.joints)
    if judgement.opened is not None:
        message = texts.describe_opening(str(event.stream_id), float(judgement.opened.coverage.mean()), follows)
    elif judgement.departed is not None:
        message = texts.describe_departure(joints, judgement.departed.version, follows)
    else:
        message = texts.describe_change(joints, evidence["suspect"], follows)
    raise_alarm(session, served.name, "change", message, evidence)
    known = {"at": change.at, "event": event.number}
    if follows == "hold":
        owner.pause(session, served.name, known | {"evidence": evidence})
        audit.note(session, served.name, "learning held", served.version, after=known)
    elif follows == "adapt":
        audit.note(session, served.name, "change decided", served.version, before=known, after={"decision": "adapt"})
