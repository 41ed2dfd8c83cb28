"""Sentences for people about learning: alarms, and the state of the learner process."""

from __future__ import annotations

from collections.abc import Sequence

from lipcore.model.parameters import FrictionName
from lipcore.model.texts import list_joints
from service.foundation.text import percent

CONSEQUENCES = {
    "hold": "Learning is paused until you decide.",
    "waits": "Learning is already paused, and these rows are not learnt until you decide.",
    "adapt": "The model adapts: what it has learnt before counts less.",
    "learn": "Learning continues as before.",
}
"""What follows from a change, by the option `on_change`; "waits" if learning was paused before."""


def describe_change(joints: str, suspect: str, follows: str) -> str:
    """Return the alarm of a sudden change of the robot. follows: a key of `CONSEQUENCES`."""
    return f"The torque of {joints} no longer fits the model (possible cause: {suspect}). {CONSEQUENCES[follows]}"


def describe_decision(decision: str) -> str:
    """Return the end of a pause after a change. decision: `adapt` or `ignore`."""
    return f"Learning continues. The change is {'learnt' if decision == 'adapt' else 'ignored'}."


def describe_departure(joints: str, version: int, follows: str) -> str:
    """Return the alarm of a slow drift from the robot that a version was trained on."""
    return f"The torque of {joints} has slowly drifted from the training of version {version}. {CONSEQUENCES[follows]}"


def describe_opening(stream_id: str, coverage: float, follows: str) -> str:
    """Return the alarm of a stream with a first second that does not fit."""
    return (
        f"Stream {stream_id} does not fit the model: coverage of the 95 % intervals in its first second is "
        f"{percent(coverage)}. Check that it is this robot, with the learnt friction and payload. "
        f"{CONSEQUENCES[follows]}"
    )


def describe_clock(stream_id: str, leap_s: float) -> str:
    """Return the alarm of a clock that is ahead of the arrival of its rows."""
    return (
        f"The clock of stream {stream_id} has jumped {leap_s:.0f} s ahead of the arrival of its rows. These rows are "
        "not learnt: they are logged with the code time_jump, and can be replayed. Set the clock back, or continue "
        "under another stream_id."
    )


def describe_payload(stream_id: str, mean: float, std: float) -> str:
    """Return the alarm that a payload was picked up. mean, std: its mass, kg."""
    return f"Stream {stream_id} carries {mean:.2f} ± {std:.2f} kg more than in training."


def describe_put_down(stream_id: str) -> str:
    """Return the alarm that a payload was put down."""
    return f"Stream {stream_id} has put down its payload."


def describe_coefficient(joint: str, name: FrictionName, mean: float, std: float, unit: str) -> str:
    """Return a coefficient of friction of a joint, as `describe_friction` lists it."""
    what = {"viscous": "viscous", "coulomb": "Coulomb", "load": "share of the load"}[name]
    number = f"{mean:.2g}".replace("-", "−")  # joint names keep their hyphens
    return f"{joint} ({what} {number} ± {std:.1g}{unit})"


def describe_friction(coefficients: Sequence[str]) -> str:
    """Return the alarm of friction that is learnt with the wrong sign. coefficients: see `describe_coefficient`."""
    return (
        f"Learnt friction is negative: {list_joints(coefficients)}. "
        "Check the torque of these joints, its sign, and the payloads of the streams."
    )


def describe_plausible_friction() -> str:
    """Return the alarm that no learnt friction is negative any more."""
    return "Learnt friction is plausible again."


def describe_novelty(version: str, share: float, rows: int) -> str:
    """Return the reason for a refresh: the basis does not represent the latest rows."""
    return f"{percent(share)} of the last {rows} samples are outside the motions that {version} can learn"


def describe_linearisation(version: str, error: float) -> str:
    """Return the reason for a refresh that an arm has left its linearisation. error: relative to the stated error."""
    return f"The arm of {version} has drifted past its linearisation, by {percent(error)} of the stated error"


def describe_refresh(reason: str) -> str:
    """Return the alarm that a refresh was queued."""
    return f"{reason}. Retraining has started."


def describe_refresh_advice(reason: str) -> str:
    """Return the alarm of a refresh that is switched off."""
    return f"{reason}. A refresh is recommended."


def describe_refresh_failure(reason: str, error: str) -> str:
    """Return the alarm of a refresh that is impossible."""
    return f"{reason}. It cannot be refreshed: {error}."


def describe_process_gone(seconds: float) -> str:
    """State that the learner process does not run."""
    return f"has not run for {seconds:.0f} s: observations are stored, but not learnt"


def describe_process_silent(seconds: float) -> str:
    """State that the learner process makes no progress."""
    return f"has made no progress for {seconds:.0f} s: observations are stored, but not learnt"


def describe_lag(events: int, seconds: float) -> str:
    """State that the learner process is behind."""
    return f"runs, but {events} events are waiting and none was learnt for {seconds:.0f} s"
