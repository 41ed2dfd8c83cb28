"""What the figures mean: warnings of what is wrong, and what to record next."""

from __future__ import annotations

from collections.abc import Iterable

from service.contract.datasets import Excitation, JointExcitation, JointLimits, JointNoise, JointSaturation, Lag, Timing
from service.datasets.report.excitation import SELDOM, SLOW
from service.datasets.report.lag import SURE, clear
from service.foundation.text import percent

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
ODD = 3
"""Joints that tell a lag, over those that differ, from which on the others speak for the clock."""
UNEVEN = 0.25
MISSING = 0.01
COLLINEAR = 0.99
SHORT_S = 60.0
TOGETHER = 0.5
"""Independent motions, as a share of the joints, below which joints count as moving together."""
MAX_LISTED = 8
"""Names in a sentence."""
STANDING = 0.5
"""Share of samples at standstill from which on it is said."""


def listed(names: Iterable[str]) -> str:
    """Names as in a sentence; of many only the first."""
    parts = list(names)
    if len(parts) > MAX_LISTED:
        parts = [*parts[:MAX_LISTED], f"{len(parts) - MAX_LISTED} more"]
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"


def warnings(
    timing: Timing, saturation: list[JointSaturation], limits: list[JointLimits], lags: list[Lag], rows: int
) -> list[str]:
    """What is wrong with a recording of so many rows, one sentence each."""
    out = []
    if timing.jitter_p99 is not None and timing.jitter_p99 > UNEVEN:
        out.append(
            f"time stamps are uneven: 1 % of the steps are off by more than {percent(timing.jitter_p99)} of the usual "
            "one; record the stamps of the robot's own clock, not those of receiving"
        )
    if timing.missing_rows > MISSING * rows:
        out.append(f"{timing.missing_rows} of {rows} rows lack a value and were left out")
    for what, field in (("positions", "beyond_range"), ("velocities", "beyond_speed"), ("torques", "beyond_torque")):
        shares = {each.joint: getattr(each, field) or 0.0 for each in limits}
        beyond = {joint: share for joint, share in shares.items() if share > BEYOND}
        if beyond:
            out.append(
                f"{what} of {listed(beyond)} are beyond the robot's limits, in up to "
                f"{percent(max(beyond.values()), 1)} of the samples: are the robot, the order of the joints and the "
                "units right?"
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
    shared, *others = lags
    late = [each for each in others if (each.cost or 0.0) > LATE and clear(each)]
    known = sum(each.seconds is not None for each in others)
    alike = [each.joint for each in others if _alike(each, shared)]
    if clear(shared) and 2 * sum(joint in alike for joint in shared.improves) > known:
        cost = max((each.cost or 0.0 for each in late if each.joint in shared.improves), default=0.0)
        if cost:
            seconds, std = shared.seconds or 0.0, shared.std_s or 0.0
            return [
                f"torque and motion are not of the same time: torque comes {1e3 * abs(seconds):.1f} ms "
                f"(± {1e3 * std:.1f}) {'after' if seconds > 0 else 'before'} motion, which turns up to "
                f"{percent(cost, 1)} of a joint's torque variance into error; use signals of one clock, filtered alike"
            ]
    odd = [each for each in others if each.improves]
    if ODD * len(odd) > known:
        return []  # where many disagree, as of motion that repeats itself, a fit may take any lag for one
    return [
        f"the torque of {each.joint} comes {1e3 * abs(each.seconds or 0.0):.0f} ms (± {1e3 * (each.std_s or 0.0):.0f}) "
        f"{'after' if (each.seconds or 0.0) > 0 else 'before'} its motion, which other joints do not show: time stamps "
        "do not explain it, filters of this joint or friction that depends on more than speed may"
        for each in late
        if (each.cost or 0.0) > VERY_LATE and each in odd and each.joint not in alike
    ]


def _alike(lag: Lag, shared: Lag) -> bool:
    """Whether a joint's lag may be the one that is shared."""
    if lag.seconds is None or lag.std_s is None or shared.seconds is None or shared.std_s is None:
        return False
    return abs(lag.seconds - shared.seconds) < SURE * lag.std_s + shared.std_s


def advice(timing: Timing, excitation: Excitation, limits: list[JointLimits], noise: list[JointNoise]) -> list[str]:
    """What to record next, the most rewarding first; one sentence for all joints that share a need."""
    joints = excitation.joints
    still = [each.joint for each in joints if each.span < STILL]
    moved = [each for each in joints if each.joint not in still]
    one_way = [each.joint for each in moved if min(each.forwards, each.backwards) < SELDOM]
    both_ways = [each for each in moved if each.joint not in one_way]
    slow = {each.joint for each in limits if each.speed_used is not None and each.speed_used < LITTLE}
    needs = [
        (still, f"moved less than {STILL:g} rad or m; move it, or leave it out with `drop_joints`"),
        (one_way, "moved in one direction only; record motion in both so that Coulomb friction shows"),
        (
            [each.joint for each in both_ways if min(each.slow_forwards, each.slow_backwards) < SELDOM],
            f"hardly ever below {SLOW:g} rad/s (m/s) in both directions; record slow motions in both directions so "
            "that Coulomb friction shows",
        ),
        (
            [each.joint for each in both_ways if "not determined" in (each.viscous.verdict, each.coulomb.verdict)],
            "viscous and Coulomb friction cannot be told from the rest; record longer, at several speeds in both "
            "directions",
        ),
        (
            [each.joint for each in both_ways if each.offset.verdict == "not determined"],
            "a constant torque cannot be told from gravity; move it through more of its range",
        ),
        (
            [each.joint for each in moved if _small(each)],
            "moved through a small part of the range; move it further, as gravity and inertia elsewhere are "
            "extrapolated",
        ),
        (
            [each.joint for each in moved if each.joint in slow],
            f"slower than {percent(LITTLE)} of the limit of speed throughout; record faster motion, if that is what "
            "the model is for",
        ),
        (
            [each.joint for each in moved if each.collinear > COLLINEAR],
            "motion is so regular that one of velocity, its sign, acceleration and gravity follows from the others; "
            "record motion of several frequencies and amplitudes",
        ),
    ]
    out = [f"{listed(names)}: {need}" for names, need in needs if names]
    bodies = excitation.whole
    if bodies is not None and bodies.rank < bodies.parameters:
        out.append(
            f"{bodies.parameters - bodies.rank} of {bodies.parameters} base parameters of the rigid bodies are hardly "
            f"excited, least that of the body that {bodies.weakest_body} moves: record faster motion of all joints at "
            "once, or plan it with `lipserve excite`"
        )
    if loud := [each.joint for each in noise if (each.torque_share or 0.0) > LOUD]:
        out.append(
            f"{listed(loud)}: noise is more than {percent(LOUD)} of the torque's spread; record larger or faster "
            "motion, and longer"
        )
    if smooth := [each.joint for each in noise if each.smoothed]:
        out.append(
            f"{listed(smooth)}: torque was smoothed before it was recorded, or simulated, so that its noise cannot be "
            "told; record it as it is measured, at least as a live stream will have it"
        )
    if (excitation.standstill or 0.0) > STANDING:
        out.append(
            f"the robot stands still in {percent(excitation.standstill or 0.0)} of the samples, which teach gravity "
            "and stiction at few places only; record motion"
        )
    dimensions = excitation.motion_dimensions
    if dimensions is not None and 0 < dimensions < TOGETHER * len(joints) and len(joints) - len(still) > 1:
        out.append(
            f"joints move together, like {dimensions:.1f} independent ones of {len(joints)}: torques of other motion "
            "are extrapolated; record motion in which each moves by itself, or plan it with `lipserve excite`"
        )
    if timing.duration_s is not None and timing.duration_s < SHORT_S:
        out.append(f"{timing.duration_s:.3g} s in all: record some minutes, so that a part can be held out to judge by")
    return out


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
    bodies = excitation.whole
    if bodies is not None:
        how = "none" if bodies.condition is None else f"{bodies.condition:.3g}"
        sentences.append(
            f"{bodies.rank} of {bodies.parameters} base parameters of the rigid bodies are excited (condition {how}), "
            f"the least at {bodies.weakest:.2g} of what random motion over the whole range would do"
        )
    return "; ".join(sentences)
