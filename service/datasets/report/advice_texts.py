"""Sentences of a report: advice on what to record."""

from __future__ import annotations

from collections.abc import Iterable

from service.datasets.report.texts import list_names
from service.foundation.text import percent


def advice_for(joints: Iterable[str], need: str) -> str:
    """Put the joints before a piece of advice. Pages show them as marks."""
    return f"{list_names(joints)}: {need}"


def still_joint(span: float) -> str:
    """Advise on joints that moved less than a span in rad or m."""
    return f"moved less than {span:g} rad or m. Move the joint, or leave it out with `drop_joints`."


ONE_DIRECTION = "moved in one direction only. Record motion in both directions to determine Coulomb friction."


def little_slow_motion(speed: float) -> str:
    """Advise on missing motion below a speed in rad/s or m/s."""
    return (
        f"too little motion below {speed:g} rad/s (m/s) in at least one direction. "
        "Record slow motion in both directions to determine Coulomb friction."
    )


UNDETERMINED_FRICTION = (
    "viscous or Coulomb friction is not determined. Record longer, at several speeds in both directions."
)
UNDETERMINED_OFFSET = "a constant torque cannot be separated from gravity. Move the joint through more of its range."
SMALL_RANGE = (
    "moved through a small part of its range. Move it further: elsewhere, gravity and inertia are extrapolated."
)


def slow_joint(share: float) -> str:
    """Advise on joints below a share of their speed limit."""
    return f"stayed below {percent(share)} of its speed limit. Record faster motion if the model needs it."


REGULAR_MOTION = (
    "motion is too regular: one of velocity, its sign, acceleration and gravity follows from the others. Record motion "
    "with several frequencies and amplitudes."
)


def noisy_torque(share: float) -> str:
    """Advise on noise above a share of the torque's standard deviation."""
    return (
        f"noise exceeds {percent(share)} of the torque's standard deviation. "
        "Record longer, with larger or faster motion."
    )


SMOOTHED_TORQUE = (
    "torque was smoothed before recording, or simulated, so its noise cannot be estimated. Record raw torque, or at "
    "least torque as in the live stream."
)


def weak_excitation(weak: int, parameters: int, weakest_body: str) -> str:
    """Advise on base parameters that are hardly excited."""
    return (
        f"{weak} of {parameters} base parameters of the rigid bodies are hardly excited, least of all those of the "
        f"body that {weakest_body} moves. "
        "Record faster motion of all joints at once, or plan it with `lipserve excite`."
    )


def undetermined_gravity(robot: str) -> str:
    """Note that a recording does not show whether its torque contains gravity."""
    return (
        f"undetermined: whether the torque contains gravity, because the gravity of {robot} hardly changes in this "
        "recording"
    )


def held_poses(share: float) -> str:
    """Report a recording of held poses."""
    return (
        f"The robot stands still in {percent(share)} of the samples: they are held poses. They show gravity and "
        "stiction, but no friction and no inertia. In motion, a model answers with gravity and a large tau_std. Record "
        "motion, too."
    )


def one_moving_joint(joint: str) -> str:
    """Report a recording in which one joint moves."""
    return (
        f"Only {joint} moves. The torque of the other joints is learnt only near their positions, and without their "
        "friction. Move all joints, or keep one: `joints` names it."
    )


def too_short(seconds: float) -> str:
    """Report a recording that is too short to judge an error."""
    return (
        f"The recording lasts {seconds:.3g} s. A held-out part of it would say little about the error, so a version of "
        "it may not serve by itself. Record several minutes."
    )


def repeated_motion(period: float) -> str:
    """Advise on motion that repeats itself. period: s."""
    return (
        f"The motion repeats every {period:.3g} s. Errors on other motion may be larger than on held-out parts of it. "
        "Record other motion, too."
    )


def much_standstill(share: float) -> str:
    """Advise on standstill in a large share of the samples."""
    return (
        f"The robot stands still in {percent(share)} of the samples. "
        "These determine only gravity and stiction, at few positions. Record motion."
    )


def dependent_motion(dimensions: float, joints: int) -> str:
    """Advise on joints that move together. dimensions: number of independent motions."""
    return (
        f"The joints move together: {joints} joints make {dimensions:.1f} independent motions. Torque of other motion "
        "is extrapolated. Record motion in which each joint moves on its own, or plan it with `lipserve excite`."
    )


def short_recording(seconds: float) -> str:
    """Advise on a short recording."""
    return (
        f"The recording lasts {seconds:.3g} s. Record several minutes, so that a part can be held out for evaluation."
    )
