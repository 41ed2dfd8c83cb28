"""Warnings of what is wrong with a recording, and advice on what to record next."""

from __future__ import annotations

from dataclasses import dataclass

from service.contract.datasets import Excitation, JointExcitation, JointLimits, JointNoise, JointSaturation, Lag, Timing
from service.datasets.report import advice_texts, texts
from service.datasets.report.excitation import FRICTION
from service.datasets.report.lag import LAG, is_nonzero


@dataclass(frozen=True)
class AdviceOptions:
    """Thresholds of warnings and advice."""

    still_span: float = 0.02
    """Span in rad or m below which a joint counts as not moved."""
    small_span: float = 0.5
    """Span in rad or m below which a joint of unknown range has moved little."""
    min_used: float = 0.3
    """Share of the range, and of the speed limit, below which more motion helps."""
    at_limit: float = 1e-3
    """Share of samples above which a torque counts as clipped or limited."""
    beyond: float = 1e-3
    """Share of samples above which a limit counts as exceeded."""
    max_noise: float = 0.1
    """Noise, as a share of the torque's standard deviation, above which better data are needed."""
    lag_cost: float = 1e-3
    """Min share of the torque's variance that a lag costs for a warning."""
    lone_lag_cost: float = 5e-3
    """Min share of the torque's variance that the lag of one joint alone costs for a warning."""
    min_agreeing: int = 3
    """Min joints with a known lag for each that differs: then the others rule out the clock."""
    jitter: float = 0.25
    """99 % quantile of a step's relative deviation above which time stamps are uneven."""
    missing: float = 0.01
    """Share of rows that lack a value above which there is a warning."""
    collinear: float = 0.99
    """Share of a feature that others explain above which motion is too regular."""
    short_s: float = 60.0
    """Duration in s below which a recording is short."""
    min_independence: float = 0.5
    """Independent motions, as a share of the joints, below which joints move together."""
    standstill: float = 0.5
    """Share of samples at standstill above which there is advice."""
    poses: float = 0.95
    """Share of samples at standstill above which a recording consists of held poses."""
    too_short_s: float = 10.0
    """Duration in s below which an error can hardly be judged."""


ADVICE = AdviceOptions()


def collect_warnings(
    timing: Timing,
    saturation: list[JointSaturation],
    limits: list[JointLimits],
    lags: list[Lag],
    rows: int,
    excitation: Excitation,
) -> list[str]:
    """Return what is wrong with a recording, one warning each. rows: of the upload."""
    out = _narrow_motion(timing, excitation)
    if timing.jitter_p99 is not None and timing.jitter_p99 > ADVICE.jitter:
        out.append(texts.uneven_times(timing.jitter_p99))
    if timing.missing_rows > ADVICE.missing * rows:
        out.append(texts.missing_values(timing.missing_rows, rows))
    for what, field in (("Positions", "beyond_range"), ("Velocities", "beyond_speed"), ("Torques", "beyond_torque")):
        shares = {each.joint: getattr(each, field) or 0.0 for each in limits}
        if beyond := {joint: share for joint, share in shares.items() if share > ADVICE.beyond}:
            out.append(texts.beyond_limits(what, beyond))
    clipped = [each.joint for each in saturation if each.flat > ADVICE.at_limit]
    if clipped:
        out.append(texts.clipped_torque(clipped))
    limited = [each.joint for each in saturation if (each.at_limit or 0.0) > ADVICE.at_limit]
    if limited := [joint for joint in limited if joint not in clipped]:
        out.append(texts.torque_at_limit(limited))
    return out + _lag_warnings(lags)


def _narrow_motion(timing: Timing, excitation: Excitation) -> list[str]:
    """Return what a recording cannot show because it is no motion, motion of one joint, or short."""
    out = []
    moved = [each.joint for each in excitation.joints if each.span >= ADVICE.still_span]
    if _has_poses_only(excitation):
        out.append(advice_texts.held_poses(excitation.standstill or 0.0))
    elif len(moved) == 1 < len(excitation.joints):
        out.append(advice_texts.one_moving_joint(moved[0]))
    if timing.duration_s is not None and timing.duration_s < ADVICE.too_short_s:
        out.append(advice_texts.too_short(timing.duration_s))
    return out


def _has_poses_only(excitation: Excitation) -> bool:
    return (excitation.standstill or 0.0) > ADVICE.poses


def _lag_warnings(lags: list[Lag]) -> list[str]:
    """A lag of all joints comes from clocks or filters; a lag of one joint may come from its friction."""
    common, *others = lags
    late = [each for each in others if (each.cost or 0.0) > ADVICE.lag_cost and is_nonzero(each)]
    known = sum(each.seconds is not None for each in others)
    alike = [each.joint for each in others if _may_equal(each, common)]
    if is_nonzero(common) and 2 * sum(joint in alike for joint in common.improves) > known:
        cost = max((each.cost or 0.0 for each in late if each.joint in common.improves), default=0.0)
        if cost:
            return [texts.common_lag(common.seconds or 0.0, common.std_s or 0.0, cost)]
    odd = [each for each in others if each.improves]
    if ADVICE.min_agreeing * len(odd) > known:
        return []  # if many disagree, as in motion that repeats itself, a fit may find any lag
    return [
        texts.lag_of_one_joint(each.joint, each.seconds or 0.0, each.std_s or 0.0)
        for each in late
        if (each.cost or 0.0) > ADVICE.lone_lag_cost and each in odd and each.joint not in alike
    ]


def _may_equal(lag: Lag, common: Lag) -> bool:
    """Return whether a joint's lag may be the common one."""
    if lag.seconds is None or lag.std_s is None or common.seconds is None or common.std_s is None:
        return False
    return abs(lag.seconds - common.seconds) < LAG.stds * lag.std_s + common.std_s


def collect_advice(
    timing: Timing, excitation: Excitation, limits: list[JointLimits], noise: list[JointNoise]
) -> list[str]:
    """Return what to record next, most important first, with one text for all joints that share a need."""
    joints, poses = excitation.joints, _has_poses_only(excitation)
    still = [each.joint for each in joints if each.span < ADVICE.still_span]
    moved = [each for each in joints if each.joint not in still]
    one_way = [each.joint for each in moved if min(each.forwards, each.backwards) < FRICTION.seldom]
    both_ways = [each for each in moved if each.joint not in one_way]
    slow = {each.joint for each in limits if each.speed_used is not None and each.speed_used < ADVICE.min_used}
    needs = [
        (still, advice_texts.still_joint(ADVICE.still_span)),
        (one_way, advice_texts.ONE_DIRECTION),
        (
            [each.joint for each in both_ways if min(each.slow_forwards, each.slow_backwards) < FRICTION.seldom],
            advice_texts.little_slow_motion(FRICTION.slow),
        ),
        (
            [each.joint for each in both_ways if "not determined" in (each.viscous.verdict, each.coulomb.verdict)],
            advice_texts.UNDETERMINED_FRICTION,
        ),
        (
            [each.joint for each in both_ways if each.offset.verdict == "not determined"],
            advice_texts.UNDETERMINED_OFFSET,
        ),
        ([each.joint for each in moved if _has_moved_little(each)], advice_texts.SMALL_RANGE),
        ([each.joint for each in moved if each.joint in slow], advice_texts.slow_joint(ADVICE.min_used)),
        ([each.joint for each in moved if each.collinear > ADVICE.collinear], advice_texts.REGULAR_MOTION),
    ]
    if poses:
        needs = [(names, need) for names, need in needs if need == advice_texts.SMALL_RANGE]
    out = [advice_texts.advice_for(names, need) for names, need in needs if names]
    bodies = None if poses else excitation.whole
    if bodies is not None and bodies.rank < bodies.parameters:
        out.append(
            advice_texts.weak_excitation(bodies.parameters - bodies.rank, bodies.parameters, bodies.weakest_body)
        )
    if noisy := [each.joint for each in noise if (each.torque_share or 0.0) > ADVICE.max_noise]:
        out.append(advice_texts.advice_for(noisy, advice_texts.noisy_torque(ADVICE.max_noise)))
    if smooth := [each.joint for each in noise if each.smoothed]:
        out.append(advice_texts.advice_for(smooth, advice_texts.SMOOTHED_TORQUE))
    if not poses and (excitation.standstill or 0.0) > ADVICE.standstill:
        out.append(advice_texts.much_standstill(excitation.standstill or 0.0))
    dimensions, n = excitation.motion_dimensions, len(joints)
    if dimensions is not None and 0 < dimensions < ADVICE.min_independence * n and n - len(still) > 1:
        out.append(advice_texts.dependent_motion(dimensions, n))
    if excitation.period_s is not None:
        out.append(advice_texts.repeated_motion(excitation.period_s))
    if timing.duration_s is not None and ADVICE.too_short_s <= timing.duration_s < ADVICE.short_s:
        out.append(advice_texts.short_recording(timing.duration_s))
    return out


def _has_moved_little(joint: JointExcitation) -> bool:
    return joint.span < ADVICE.small_span if joint.visited is None else joint.visited < ADVICE.min_used


def describe_excitation(excitation: Excitation) -> str:
    """Summarise how well the data determine friction and rigid bodies."""
    sentences = []
    terms = (("Viscous friction", "viscous"), ("Coulomb friction", "coulomb"), ("Constant torque", "offset"))
    for term, field in terms:
        by_verdict = {
            verdict: [each.joint for each in excitation.joints if getattr(each, field).verdict == verdict]
            for verdict in ("well", "poorly", "not determined")
        }
        sentences.append(texts.friction_summary(term, by_verdict, len(excitation.joints)))
    bodies = excitation.whole
    if bodies is not None:
        sentences.append(texts.bodies_summary(bodies.rank, bodies.parameters, bodies.condition, bodies.weakest))
    return " ".join(sentences)
