"""What the figures mean: warnings of what is wrong, and what to record next."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from service.contract.datasets import Excitation, JointExcitation, JointLimits, JointNoise, JointSaturation, Lag, Timing
from service.datasets.report.excitation import FRICTION
from service.datasets.report.lag import LAG, clear
from service.foundation.text import percent


@dataclass(frozen=True)
class AdviceOptions:
    """When a report warns, and when it advises what to record."""

    still_span: float = 0.02
    """Span in rad or m below which a joint counts as not moved."""
    small_span: float = 0.5
    """Span in rad or m below which a joint of unknown range has moved little."""
    little: float = 0.3
    """Share of the range, and of the speed limit, below which more motion helps."""
    at_limit: float = 1e-3
    """Share of samples above which a torque counts as cut off or limited."""
    beyond: float = 1e-3
    """Share of samples above which a limit counts as exceeded."""
    loud: float = 0.1
    """Noise, as a share of the torque's spread, that calls for better data."""
    lag_cost: float = 1e-3
    """Share of the torque's variance that a lag has to cost for a warning."""
    lone_lag_cost: float = 5e-3
    """The same where only one joint is late."""
    agreeing: int = 3
    """Min joints with a known lag for each that differs: the others then speak for the clock."""
    jitter: float = 0.25
    """99 % quantile of a step's relative deviation above which time stamps are uneven."""
    missing: float = 0.01
    """Share of rows that lack a value above which it is said."""
    collinear: float = 0.99
    """Share of a feature that others explain above which motion is too regular."""
    short_s: float = 60.0
    """Duration in s below which a recording is short."""
    together: float = 0.5
    """Independent motions, as a share of the joints, below which joints move together."""
    standstill: float = 0.5
    """Share of samples at standstill above which it is said."""


ADVICE = AdviceOptions()


def listed(names: Iterable[str]) -> str:
    """Names as in a sentence; of many only the first eight."""
    parts = list(names)
    if len(parts) > 8:
        parts = [*parts[:8], f"{len(parts) - 8} more"]
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"


def warnings(
    timing: Timing, saturation: list[JointSaturation], limits: list[JointLimits], lags: list[Lag], rows: int
) -> list[str]:
    """What is wrong with a recording of so many rows, one sentence each."""
    out = []
    if timing.jitter_p99 is not None and timing.jitter_p99 > ADVICE.jitter:
        out.append(
            f"time stamps are uneven: 1 % of the steps are off by more than {percent(timing.jitter_p99)} of the usual "
            "one; record the stamps of the robot's own clock, not those of receiving"
        )
    if timing.missing_rows > ADVICE.missing * rows:
        out.append(f"{timing.missing_rows} of {rows} rows lack a value and were left out")
    for what, field in (("positions", "beyond_range"), ("velocities", "beyond_speed"), ("torques", "beyond_torque")):
        shares = {each.joint: getattr(each, field) or 0.0 for each in limits}
        beyond = {joint: share for joint, share in shares.items() if share > ADVICE.beyond}
        if beyond:
            out.append(
                f"{what} of {listed(beyond)} are beyond the robot's limits, in up to "
                f"{percent(max(beyond.values()), 1)} of the samples: are the robot, the order of the joints and the "
                "units right?"
            )
    cut = [each.joint for each in saturation if each.flat > ADVICE.at_limit]
    if cut:
        out.append(
            f"the torque of {listed(cut)} stays at its largest value while the joint moves: it was cut off there"
        )
    met = [each.joint for each in saturation if (each.at_limit or 0.0) > ADVICE.at_limit and each.joint not in cut]
    if met:
        out.append(f"the torque of {listed(met)} meets the robot's limit: what was commanded may not have been reached")
    return out + _late(lags)


def _late(lags: list[Lag]) -> list[str]:
    """A lag that all joints share is one of clocks or filters; that of one joint alone may be its friction's."""
    shared, *others = lags
    late = [each for each in others if (each.cost or 0.0) > ADVICE.lag_cost and clear(each)]
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
    if ADVICE.agreeing * len(odd) > known:
        return []  # where many disagree, as of motion that repeats itself, a fit may take any lag for one
    return [
        f"the torque of {each.joint} comes {1e3 * abs(each.seconds or 0.0):.0f} ms (± {1e3 * (each.std_s or 0.0):.0f}) "
        f"{'after' if (each.seconds or 0.0) > 0 else 'before'} its motion, which other joints do not show: time stamps "
        "do not explain it, filters of this joint or friction that depends on more than speed may"
        for each in late
        if (each.cost or 0.0) > ADVICE.lone_lag_cost and each in odd and each.joint not in alike
    ]


def _alike(lag: Lag, shared: Lag) -> bool:
    """Whether a joint's lag may be the one that is shared."""
    if lag.seconds is None or lag.std_s is None or shared.seconds is None or shared.std_s is None:
        return False
    return abs(lag.seconds - shared.seconds) < LAG.stds * lag.std_s + shared.std_s


def advice(timing: Timing, excitation: Excitation, limits: list[JointLimits], noise: list[JointNoise]) -> list[str]:
    """What to record next, the most rewarding first; one sentence for all joints that share a need."""
    joints = excitation.joints
    still = [each.joint for each in joints if each.span < ADVICE.still_span]
    moved = [each for each in joints if each.joint not in still]
    one_way = [each.joint for each in moved if min(each.forwards, each.backwards) < FRICTION.seldom]
    both_ways = [each for each in moved if each.joint not in one_way]
    slow = {each.joint for each in limits if each.speed_used is not None and each.speed_used < ADVICE.little}
    needs = [
        (still, f"moved less than {ADVICE.still_span:g} rad or m; move it, or leave it out with `drop_joints`"),
        (one_way, "moved in one direction only; record motion in both so that Coulomb friction shows"),
        (
            [each.joint for each in both_ways if min(each.slow_forwards, each.slow_backwards) < FRICTION.seldom],
            f"hardly ever below {FRICTION.slow:g} rad/s (m/s) in both directions; record slow motions in both "
            "directions so that Coulomb friction shows",
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
            f"slower than {percent(ADVICE.little)} of the limit of speed throughout; record faster motion, if that is "
            "what the model is for",
        ),
        (
            [each.joint for each in moved if each.collinear > ADVICE.collinear],
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
    if loud := [each.joint for each in noise if (each.torque_share or 0.0) > ADVICE.loud]:
        out.append(
            f"{listed(loud)}: noise is more than {percent(ADVICE.loud)} of the torque's spread; record larger or "
            "faster motion, and longer"
        )
    if smooth := [each.joint for each in noise if each.smoothed]:
        out.append(
            f"{listed(smooth)}: torque was smoothed before it was recorded, or simulated, so that its noise cannot be "
            "told; record it as it is measured, at least as a live stream will have it"
        )
    if (excitation.standstill or 0.0) > ADVICE.standstill:
        out.append(
            f"the robot stands still in {percent(excitation.standstill or 0.0)} of the samples, which teach gravity "
            "and stiction at few places only; record motion"
        )
    dimensions = excitation.motion_dimensions
    if dimensions is not None and 0 < dimensions < ADVICE.together * len(joints) and len(joints) - len(still) > 1:
        out.append(
            f"joints move together, like {dimensions:.1f} independent ones of {len(joints)}: torques of other motion "
            "are extrapolated; record motion in which each moves by itself, or plan it with `lipserve excite`"
        )
    if timing.duration_s is not None and timing.duration_s < ADVICE.short_s:
        out.append(f"{timing.duration_s:.3g} s in all: record some minutes, so that a part can be held out to judge by")
    return out


def _small(joint: JointExcitation) -> bool:
    return joint.span < ADVICE.small_span if joint.visited is None else joint.visited < ADVICE.little


def in_words(excitation: Excitation) -> str:
    """How well the data determine friction and rigid bodies."""
    sentences = []
    terms = (("viscous friction", "viscous"), ("Coulomb friction", "coulomb"), ("constant torque", "offset"))
    for term, field in terms:
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
