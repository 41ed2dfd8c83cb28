"""The report of a data set. It is made column by column; figures on several joints use a subset of rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lipcore import profiles
from lipcore.data.independence import motion_dimensions
from lipcore.data.repetition import find_period
from lipcore.data.samples import Array, Samples
from lipcore.kernels.drive.terms import SIGN_WIDTH
from lipcore.preparation.recipe import Recipe
from lipcore.profiles import Profile
from service.contract import datasets as schema
from service.datasets.mapping.joints import WARNING
from service.datasets.report import advice_texts, texts
from service.datasets.report.advice import collect_advice, collect_warnings, describe_excitation
from service.datasets.report.bodies import Bodies, Comparison, Signals, compare
from service.datasets.report.causes import TorqueWork, find_faults
from service.datasets.report.excitation import (
    RigidExcitation,
    joint_excitation,
    judge_friction,
    judge_rigid_bodies,
)
from service.datasets.report.fit import make_fit
from service.datasets.report.lag import Lags, is_nonzero, shifts, unknown_lags
from service.datasets.report.remedies import Upload
from service.datasets.report.robots import ask_for_robot, bodies_of, find_candidates, suggest_robot
from service.datasets.report.signals import (
    Limits,
    RecordedTimes,
    analyse_times,
    bounds,
    compare_with_limits,
    detect_saturation,
    finite_or_none,
    is_smoothed,
    limits_of,
    noise_or_default,
    number_parts,
    spread,
    thin,
    white_noise,
)
from service.datasets.staging import EPISODE, QUANTITIES, TIME, Prepared, Staged, column


def make_report(
    raw: Staged,
    prepared: Prepared,
    profile: Profile | None,
    noted: list[str],
    recipe: Recipe | None = None,
    gravity: bool = True,
    source: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the report as JSON, see `DatasetReport`.

    noted: notes and warnings of the reader; recipe: of the preparation, None for the defaults; gravity: whether torques
    contain it; source: how the file's columns were read, None if unknown.
    """
    recipe = recipe or Recipe()
    names = raw.joint_names
    limits = limits_of(profile, names)
    times = analyse_times(raw, recipe.gap_steps, prepared.repeated)
    recorded = _analyse_raw(raw, times, limits)
    samples = _analyse_samples(prepared, limits)
    upload, signals = Upload(names, gravity, source), Signals(*samples.motion, samples.tau)
    candidates, best = find_candidates(names, signals) if profile is None else ((), None)
    known = profile if best is None else profiles.profile(best)
    rigid = _rigid_bodies(known, limits_of(known, names), prepared, samples, gravity)
    excitation = _excitation(samples, rigid, prepared, limits)
    reading = [note for note in noted if not note.startswith(WARNING)]
    warned = [note.removeprefix(WARNING) for note in noted if note.startswith(WARNING)]
    if profile is not None and limits is None:
        reading.append(texts.no_joint_matches(profile.name))
    if profile is not None and limits is not None and limits.by_order:
        reading.append(texts.matched_by_order(profile.name))
    if isinstance(rigid, str) and profile is not None:
        reading.append(rigid)
    if isinstance(rigid, RigidExcitation) and best is not None:
        reading.append(texts.bodies_suggested(best))
    against, remedies = _compare_with_robot(known, upload, signals, samples, excitation)
    proposal = suggest_robot(upload, candidates, best)
    suggested = [] if proposal is None else [proposal]
    unknown = ask_for_robot(len(names)) if profile is None and proposal is None else None
    if gravity and against is not None and not _is_gravity_determined(against):
        reading.append(advice_texts.undetermined_gravity(against.robot))
    robot_advice = [each.text for each in suggested] + ([] if unknown is None else [unknown])
    report = schema.DatasetReport(
        rows_uploaded=raw.rows,
        rows=prepared.staged.rows,
        episodes=prepared.episodes,
        rate_hz=prepared.rate_hz,
        gaps=prepared.gaps,
        derived=list(prepared.derived),
        preparation=[str(step["text"]) for step in prepared.steps],
        ranges={
            quantity: {"min": [low for low, _ in pairs], "max": [high for _, high in pairs]}
            for quantity, pairs in samples.ranges.items()
        },
        torque_noise_estimate=samples.noise,
        warnings=warned
        + _closed_brakes(raw, prepared)
        + [each.text for each in remedies]
        + collect_warnings(times.timing, recorded.saturation, recorded.limits, samples.lags, raw.rows, excitation),
        reading=reading,
        recipe=recipe.to_json(),
        source=source,
        steps=prepared.steps,
        robot=None if profile is None or limits is None else profile.name,
        timing=times.timing,
        saturation=recorded.saturation,
        limits=recorded.limits,
        lag=samples.lags,
        noise=recorded.noise,
        excitation=excitation,
        against_robot=against,
        remedies=remedies + suggested,
        advice=robot_advice + collect_advice(times.timing, excitation, recorded.limits, recorded.noise),
    )
    return report.model_dump(mode="json")


MAX_GRAVITY_STD = 0.3
"""Standard deviation of gravity's factor, 1 with and 0 without gravity, below which both can be told apart."""


@dataclass(frozen=True)
class _Recorded:
    """Findings about the signals as recorded, joint by joint."""

    saturation: list[schema.JointSaturation]
    limits: list[schema.JointLimits]
    noise: list[schema.JointNoise]


@dataclass(frozen=True)
class _Samples:
    """Findings about the prepared samples."""

    ranges: dict[str, list[tuple[float, float]]]
    """Smallest and largest value by quantity and joint."""
    noise: list[float]
    """White noise of each joint's torque, N·m."""
    residuals: Array
    """Standard deviation of the torque that motion does not explain, (n,) N·m."""
    speeds: Array
    """Root mean square of the velocity, (n,)."""
    torques: Array
    """Standard deviation of the torque, (n,)."""
    lags: list[schema.Lag]
    excitation: list[schema.JointExcitation]
    rows: NDArray[np.int64]
    """A subset of rows, (R,)."""
    motion: tuple[Array, Array, Array]
    """q, dq and ddq at these rows, (R, n) each."""
    tau: Array
    """Torque at these rows, (R, n)."""
    work: TorqueWork


def _analyse_raw(raw: Staged, times: RecordedTimes, limits: Limits | None) -> _Recorded:
    out = _Recorded([], [], [])
    some_missing = bool(times.missing.any())
    for joint, name in enumerate(raw.joint_names):
        columns = raw.joint(joint)
        noise = {each: white_noise(columns[each], times.part, robust=True) for each in ("tau", "dq") if each in columns}
        smooth = is_smoothed(columns["tau"], times.part, noise["tau"])
        if some_missing:
            columns = {each: values[~times.missing] for each, values in columns.items()}
        out.limits.append(compare_with_limits(joint, name, columns, limits))
        out.saturation.append(detect_saturation(joint, name, columns["q"], columns["tau"], limits))
        torque, velocity = None if smooth else noise["tau"], noise.get("dq")
        out.noise.append(
            schema.JointNoise(
                joint=name,
                torque=torque,
                torque_share=_share(torque, columns["tau"]),
                velocity=velocity,
                velocity_share=None if velocity is None else _share(velocity, columns["dq"]),
                smoothed=smooth,
            )
        )
    return out


def _closed_brakes(raw: Staged, prepared: Prepared) -> list[str]:
    """Return a warning of rows with closed brakes, if there are any."""
    braked = prepared.braked
    if not braked.joints:
        return []
    t = raw.read(TIME)
    spans = [(float(t[first] - np.nanmin(t)), float(t[last] - np.nanmin(t))) for first, last in braked.stretches]
    return [texts.closed_brakes([raw.joint_names[joint] for joint in braked.joints], float(braked.rows.mean()), spans)]


def _share(level: float | None, values: Array) -> float | None:
    wide = spread(values)
    return None if level is None or wide == 0 else level / wide


def _analyse_samples(prepared: Prepared, limits: Limits | None) -> _Samples:
    staged, rate = prepared.staged, prepared.rate_hz
    part = number_parts(staged.rows, [np.diff(staged.read(EPISODE)) != 0])
    starts, ends = bounds(part)
    steps = None if rate is None else shifts(rate, int((ends - starts).max()))
    # figures on several joints use a subset of rows
    rows = thin(part, 2000, 0 if steps is None else int(steps[-1]))
    motion = (staged.table("q", rows), staged.table("dq", rows), staged.table("ddq", rows))
    tau = staged.table("tau", rows)
    fit = make_fit(rows, *motion, tau=tau, independent=_independent(prepared))
    lags = None if steps is None or rate is None else Lags(fit, steps, rate)
    ranges: dict[str, list[tuple[float, float]]] = {quantity: [] for quantity in QUANTITIES}
    levels, residuals, speeds, torques = np.empty((4, staged.n_joints))
    joint_lags, excitation, power = [], [], np.zeros(staged.rows)
    for joint, name in enumerate(staged.joint_names):
        columns = {quantity: staged.read(column(quantity, joint)) for quantity in QUANTITIES}
        for quantity, values in columns.items():
            ranges[quantity].append((float(values.min()), float(values.max())))
        levels[joint] = noise_or_default(columns["tau"], part)
        power += columns["tau"] * columns["dq"]
        speeds[joint], torques[joint] = np.sqrt(np.mean(columns["dq"] ** 2)), columns["tau"].std()
        if lags is None:
            residuals[joint] = np.sqrt(np.mean(fit.residuals(columns["tau"][rows, None]) ** 2))
        else:
            lag, residuals[joint] = lags.estimate_joint(name, columns["tau"])
            joint_lags.append(lag)
        excitation.append(joint_excitation(joint, name, columns, part, fit, float(residuals[joint]), limits))
    if lags is None:
        why = texts.NO_TIMES if rate is None else texts.SHORT_PARTS
        joint_lags = unknown_lags(staged.joint_names, why)
    else:
        joint_lags.insert(0, lags.combine())
        for joint, name in enumerate(staged.joint_names):
            torque = staged.read(column("tau", joint))
            for lag in (joint_lags[0], joint_lags[joint + 1]):
                if is_nonzero(lag) and lags.lowers_error(torque, lag.seconds or 0.0):
                    lag.improves.append(name)
    return _Samples(
        ranges,
        levels.tolist(),
        residuals,
        speeds,
        torques,
        joint_lags,
        excitation,
        rows,
        motion,
        tau,
        TorqueWork.of(power),
    )


def _independent(prepared: Prepared) -> float:
    """Return the effective samples: two per period of the low-pass cut-off, without a low-pass all."""
    samples = float(prepared.staged.rows)
    if prepared.cutoff_hz is None or prepared.rate_hz is None:
        return samples
    return samples * min(1.0, 2 * prepared.cutoff_hz / prepared.rate_hz)


def _rigid_bodies(
    profile: Profile | None, limits: Limits | None, prepared: Prepared, samples: _Samples, gravity: bool
) -> RigidExcitation | str | None:
    if profile is None or limits is None or profile.urdf is None:
        return None
    names, independent = prepared.staged.joint_names, _independent(prepared)
    return judge_rigid_bodies(
        profile.urdf, profile.name, names, limits, samples.motion, samples.tau, samples.residuals, independent, gravity
    )


def _excitation(
    samples: _Samples, rigid: RigidExcitation | str | None, prepared: Prepared, limits: Limits | None
) -> schema.Excitation:
    """Return the excitation; rigid bodies, if known, replace the judgement of friction by motion alone."""
    if not isinstance(rigid, RigidExcitation):
        out = schema.Excitation(friction_beside="any motion", joints=samples.excitation, whole=None, text="")
    else:
        joints = [
            each.model_copy(update=judge_friction(friction, speed, torque, each.forwards, each.backwards))
            for each, friction, speed, torque in zip(
                samples.excitation, rigid.friction, samples.speeds, samples.torques, strict=True
            )
        ]
        out = schema.Excitation(friction_beside="rigid bodies", joints=joints, whole=rigid.whole, text="")
    dq = samples.motion[1]
    out.standstill = float(np.mean(np.all(np.abs(dq) < SIGN_WIDTH, axis=1)))
    out.motion_dimensions = motion_dimensions(dq)
    if prepared.rate_hz is not None and out.motion_dimensions:
        staged, types = prepared.staged, None if limits is None else limits.joint_types
        episode, t = staged.read(EPISODE)[samples.rows].astype(np.int64), staged.read(TIME)[samples.rows]
        known = Samples(staged.joint_names, t, episode, *samples.motion, samples.tau)
        out.period_s = find_period(known, types or ("revolute",) * staged.n_joints)
    out.text = describe_excitation(out)
    return out


def _compare_with_robot(
    robot: Profile | None, upload: Upload, signals: Signals, samples: _Samples, excitation: schema.Excitation
) -> tuple[schema.AgainstRobot | None, list[schema.Remedy]]:
    """Compare torque with that of the robot, named or suggested by the joint names, and find faults."""
    bodies = None if robot is None else bodies_of(robot, upload.names)
    comparison = None if bodies is None else compare(bodies, signals)
    faults = find_faults(upload, bodies, comparison, signals, excitation.joints, samples.work)
    return None if bodies is None or comparison is None else _show(bodies, comparison), faults


def _is_gravity_determined(against: schema.AgainstRobot) -> bool:
    """Return whether the torque of some joint shows whether it contains gravity."""
    return any(each.gravity is not None and (each.gravity_std or 0.0) < MAX_GRAVITY_STD for each in against.joints)


def _show(bodies: Bodies, comparison: Comparison) -> schema.AgainstRobot:
    joints = []
    for joint, name in enumerate(bodies.names):
        # a factor of an invisible part would be rounding noise
        visible_parts = [bool(visible > 1e-3) for visible in comparison.visible[joint]]
        joints.append(
            schema.JointAgainstRobot(
                joint=name,
                gravity=finite_or_none(comparison.gravity[joint]) if visible_parts[0] else None,
                gravity_std=finite_or_none(comparison.gravity_std[joint]) if visible_parts[0] else None,
                inertia=finite_or_none(comparison.inertia[joint]) if visible_parts[1] else None,
                inertia_std=finite_or_none(comparison.inertia_std[joint]) if visible_parts[1] else None,
                explained=float(comparison.explained[joint]),
            )
        )
    return schema.AgainstRobot(robot=bodies.name, joints=joints)
