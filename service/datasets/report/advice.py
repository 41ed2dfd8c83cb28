"""What the figures mean: warnings of what is wrong, and what to record next."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from service.datasets.report.excitation import SELDOM, SLOW
from service.datasets.schema import (
    Excitation,
    JointExcitation,
    JointLimits,
    JointNoise,
    JointSaturation,
    Lag,
    Timing,
)

TERMS = (("viscous friction", "viscous"), ("Coulomb friction", "coulomb"), ("constant torque", "offset"))
STILL = 0.02
"""rad or m within which a joint counts as not moved."""
SMALL_SPAN = 0.5
"""rad or m below which a joint of unknown range counts as moved little."""
LITTLE = 0.3
"""Share of the range, and of the limit of speed, below which more would teach more."""
SATURATED = BEYOND = 1e-3
"""Share of samples from which on a limit counts as met, or as passed."""
LOUD = 0.1
"""Noise over the torque's spread that calls for better data."""
LATE = 1e-3
"""Share of the torque's variance from which on a lag is worth a warning."""
VERY_LATE = 5e-3
"""The same where only one joint is late."""
SURE = 3.0
"""Standard deviations that a lag has to differ by."""
UNEVEN = 0.25
MISSING = 0.01
COLLINEAR = 0.99
SHORT_S = 60.0


def listed(names: Iterable[str], most: int = 8) -> str:
    """Names as in a sentence; of many only the first."""
    shown = list(names)
    if len(shown) > most:
        shown = [*shown[:most], f"{len(shown) - most} more"]
    return shown[0] if len(shown) == 1 else f"{', '.join(shown[:-1])} and {shown[-1]}"


def warnings(
    timing: Timing, saturation: list[JointSaturation], limits: list[JointLimits], lags: list[Lag], rows: int
) -> list[str]:
    """What is wrong with a recording of so many rows, one sentence each."""
    out = []
    if timing.jitter_p99 is not None and timing.jitter_p99 > UNEVEN:
        out.append(
            f"time stamps are uneven: 1 % of the steps are off by more than {timing.jitter_p99:.0%} of the usual one; "
            "record the stamps of the robot's own clock, not those of receiving"
        )
    if timing.missing_rows > MISSING * rows:
        out.append(f"{timing.missing_rows} of {rows} rows lack a value and were left out")
    for what, field in (
        ("positions", "beyond_range"),
        ("velocities", "beyond_speed"),
        ("torques", "beyond_torque"),
    ):
        shares = {each.joint: getattr(each, field) or 0.0 for each in limits}
        beyond = {joint: share for joint, share in shares.items() if share > BEYOND}
        if beyond:
            out.append(
                f"{what} of {listed(beyond)} are beyond the robot's limits, in up to {max(beyond.values()):.1%} of the "
                "samples: are the robot, the order of the joints and the units right?"
            )
    cut = [each.joint for each in saturation if each.flat > SATURATED]
    if cut:
        out.append(
            f"the torque of {listed(cut)} stays at its largest value while the joint moves: it was cut off there"
        )
    met = [each.joint for each in saturation if (each.at_limit or 0.0) > SATURATED and each.joint not in cut]
    if met:
        out.append(f"the torque of {listed(met)} meets the robot's limit: what was commanded may not have been reached")
    return out + _late(lags)


def _late(lags: list[Lag]) -> list[str]:
    """A lag that all joints share is one of clocks or filters; that of one joint alone may be its friction's."""
    late = [each for each in lags[1:] if each.seconds is not None and (each.cost or 0.0) > LATE and _sure(each)]
    shared = lags[0]
    if shared.seconds is not None and _sure(shared):
        alike = [each for each in late if abs(_seconds(each) - shared.seconds) < SURE * _std(each) + _std(shared)]
        if alike:
            worst = max(each.cost or 0.0 for each in alike)
            side = "after" if shared.seconds > 0 else "before"
            return [
                f"torque and motion are not of the same time: torque comes {1e3 * abs(shared.seconds):.1f} ms "
                f"(± {1e3 * _std(shared):.1f}) {side} motion, which turns up to {worst:.1%} of a joint's torque "
                "variance into error; use signals of one clock, filtered alike"
            ]
    return [
        f"the torque of {each.joint} comes {1e3 * abs(_seconds(each)):.0f} ms (± {1e3 * _std(each):.0f}) "
        f"{'after' if _seconds(each) > 0 else 'before'} its motion, which other joints do not show: time stamps do not "
        "explain it, filters of this joint or friction that depends on more than speed may"
        for each in late
        if (each.cost or 0.0) > VERY_LATE
    ]


def _sure(lag: Lag) -> bool:
    return abs(_seconds(lag)) > SURE * _std(lag)


def _seconds(lag: Lag) -> float:
    return lag.seconds or 0.0


def _std(lag: Lag) -> float:
    return lag.std_s or 0.0


def advice(timing: Timing, excitation: Excitation, limits: list[JointLimits], noise: list[JointNoise]) -> list[str]:
    """What to record next, the most rewarding first; one sentence for all joints that share a need."""
    joints = excitation.joints
    still = [each.joint for each in joints if each.span < STILL]
    moved = [each for each in joints if each.joint not in still]
    out: list[str] = []

    def say(affected: Iterable[str], sentence: Callable[[str], str]) -> None:
        names = list(affected)
        if names:
            out.append(sentence(listed(names)))

    say(
        still,
        lambda names: f"{names}: moved less than {STILL:g} rad or m; move it, or leave it out with `drop_joints`",
    )
    _say_friction(moved, say)
    say(
        (each.joint for each in moved if _small(each)),
        lambda names: (
            f"{names}: moved through a small part of the range; move it further, as gravity and inertia "
            "elsewhere are extrapolated"
        ),
    )
    slow = {each.joint for each in limits if each.speed_used is not None and each.speed_used < LITTLE}
    say(
        (each.joint for each in moved if each.joint in slow),
        lambda names: (
            f"{names}: slower than {LITTLE:.0%} of the limit of speed throughout; record faster motion, "
            "if that is what the model is for"
        ),
    )
    say(
        (each.joint for each in moved if each.collinear > COLLINEAR),
        lambda names: (
            f"{names}: motion is so regular that one of velocity, its sign, acceleration and gravity follows "
            "from the others; record motion of several frequencies and amplitudes"
        ),
    )
    bodies = excitation.whole
    if bodies is not None and bodies.rank < bodies.parameters:
        out.append(
            f"{bodies.parameters - bodies.rank} of {bodies.parameters} base parameters of the rigid bodies are hardly "
            f"excited, least that of the body that {bodies.weakest_body} moves: record faster motion of all joints at "
            "once, or plan it with `lipserve excite`"
        )
    say(
        (each.joint for each in noise if (each.torque_share or 0.0) > LOUD),
        lambda names: (
            f"{names}: noise is more than {LOUD:.0%} of the torque's spread; record larger or faster motion, and longer"
        ),
    )
    if timing.duration_s is not None and timing.duration_s < SHORT_S:
        out.append(f"{timing.duration_s:.3g} s in all: record some minutes, so that a part can be held out to judge by")
    return out


def _say_friction(moved: list[JointExcitation], say: Callable[[Iterable[str], Callable[[str], str]], None]) -> None:
    """What friction lacks, joint by joint."""
    one_way = [each.joint for each in moved if min(each.forwards, each.backwards) < SELDOM]
    say(
        one_way,
        lambda names: f"{names}: moved in one direction only; record motion in both so that Coulomb friction shows",
    )
    rest = [each for each in moved if each.joint not in one_way]
    say(
        (each.joint for each in rest if min(each.slow_forwards, each.slow_backwards) < SELDOM),
        lambda names: (
            f"{names}: hardly ever below {SLOW:g} rad/s (m/s) in both directions; record slow motions in "
            "both directions so that Coulomb friction shows"
        ),
    )
    say(
        (each.joint for each in rest if "not determined" in (each.viscous.verdict, each.coulomb.verdict)),
        lambda names: (
            f"{names}: viscous and Coulomb friction cannot be told from the rest; record longer, at several "
            "speeds in both directions"
        ),
    )
    say(
        (each.joint for each in rest if each.offset.verdict == "not determined"),
        lambda names: f"{names}: a constant torque cannot be told from gravity; move it through more of its range",
    )


def _small(joint: JointExcitation) -> bool:
    return joint.span < SMALL_SPAN if joint.visited is None else joint.visited < LITTLE


def in_words(excitation: Excitation) -> str:
    """How well the data determine friction and rigid bodies."""
    sentences = []
    for term, field in TERMS:
        by = {
            verdict: [each.joint for each in excitation.joints if getattr(each, field).verdict == verdict]
            for verdict in ("well", "poorly", "not determined")
        }
        if len(by["well"]) == len(excitation.joints):
            sentences.append(f"{term} is determined well for all joints")
        else:
            sentences.append(
                f"{term}: " + ", ".join(f"{verdict} for {listed(who)}" for verdict, who in by.items() if who)
            )
    whole = excitation.whole
    if whole is not None:
        how = "none" if whole.condition is None else f"{whole.condition:.3g}"
        sentences.append(
            f"{whole.rank} of {whole.parameters} base parameters of the rigid bodies are excited (condition {how}), "
            f"the least at {whole.weakest:.2g} of what random motion over the whole range would do"
        )
    return "; ".join(sentences)
