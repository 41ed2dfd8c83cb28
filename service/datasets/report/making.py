"""The report of a data set, made column by column: of what spans several joints only few rows are taken."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lipcore import profiles
from lipcore.data.independence import motion_dimensions
from lipcore.data.samples import Array
from lipcore.kernels.friction import SIGN_WIDTH
from lipcore.preparation.recipe import Recipe
from lipcore.profiles import Profile
from service.contract import datasets as schema
from service.datasets.mapping.choice import WARNING
from service.datasets.report.advice import advice, in_words, warnings
from service.datasets.report.bodies import Against, Bodies, Signals, compare
from service.datasets.report.causes import TorqueWork, causes
from service.datasets.report.excitation import FRICTION, RigidExcitation, joint_excitation, judge_rigid_bodies, weights
from service.datasets.report.fit import make_fit
from service.datasets.report.lag import Lags, clear, no_lags, shifts
from service.datasets.report.remedies import Upload
from service.datasets.report.robots import bodies_of, proposed, suggestion, unnamed
from service.datasets.report.signals import (
    Limits,
    RecordedTimes,
    against_limits,
    bounds,
    finite,
    limits_of,
    look_at_clock,
    noise_or_share,
    number_parts,
    saturation,
    smoothed,
    spread,
    thin,
    white_noise,
)
from service.datasets.staging import EPISODE, QUANTITIES, Prepared, Staged, column


def make_report(
    raw: Staged,
    prepared: Prepared,
    profile: Profile | None,
    noted: list[str],
    recipe: Recipe | None = None,
    gravity: bool = True,
    source: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """The report as JSON, see DatasetReport.

    noted: what was found while the file was read; recipe: that of the preparation, the defaults where None; gravity:
    whether torques contain it; source: what the file's columns were taken as, None where that is not known.
    """
    recipe = recipe or Recipe()
    names = raw.joint_names
    limits = limits_of(profile, names)
    clock = look_at_clock(raw, recipe.gap_steps, prepared.repeated)
    recorded = _look_at_raw(raw, clock, limits)
    samples = _look_at_samples(prepared, limits)
    upload, signals = Upload(names, gravity, source), Signals(*samples.motion, samples.tau)
    candidates, best = proposed(names, signals) if profile is None else ((), None)
    known = profile if best is None else profiles.profile(best)
    rigid = _rigid_bodies(known, limits_of(known, names), prepared, samples, gravity)
    excitation = _excitation(samples, rigid)
    reading = [note for note in noted if not note.startswith(WARNING)]
    warned = [note.removeprefix(WARNING) for note in noted if note.startswith(WARNING)]
    if profile is not None and limits is None:
        reading.append(f"the joints of robot {profile.name} are not those of the data: limits were not compared")
    if profile is not None and limits is not None and limits.by_order:
        reading.append(f"joints were taken for those of robot {profile.name} by their order")
    if isinstance(rigid, str) and profile is not None:
        reading.append(rigid)
    if isinstance(rigid, RigidExcitation) and profile is None:
        reading.append(f"friction is judged beside the rigid bodies of {best}, as whose the joints are called")
    against, remedies = _against_robot(known, upload, signals, samples, excitation)
    proposal = suggestion(upload, candidates, best)
    suggested = [] if proposal is None else [proposal]
    unknown = unnamed(len(names)) if profile is None and proposal is None else None
    named = [each.text for each in suggested] + ([] if unknown is None else [unknown])
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
        + [each.text for each in remedies]
        + warnings(clock.timing, recorded.saturation, recorded.limits, samples.lags, raw.rows),
        reading=reading,
        recipe=recipe.to_json(),
        source=source,
        steps=prepared.steps,
        robot=None if profile is None or limits is None else profile.name,
        timing=clock.timing,
        saturation=recorded.saturation,
        limits=recorded.limits,
        lag=samples.lags,
        noise=recorded.noise,
        excitation=excitation,
        against_robot=against,
        remedies=remedies + suggested,
        advice=named + advice(clock.timing, excitation, recorded.limits, recorded.noise),
    )
    return report.model_dump(mode="json")


@dataclass(frozen=True)
class _Recorded:
    """What the signals as recorded show, joint by joint."""

    saturation: list[schema.JointSaturation]
    limits: list[schema.JointLimits]
    noise: list[schema.JointNoise]


@dataclass(frozen=True)
class _Samples:
    """What the samples show. ranges: smallest and largest by quantity and joint; noise: white, of the torque; left: std
    of the torque that no motion explains, both N·m; motion: q, dq, ddq at few rows, (R, n) each, tau: torque there;
    speeds, torques: root mean square and standard deviation, (n,); work: of all torques.
    """

    ranges: dict[str, list[tuple[float, float]]]
    noise: list[float]
    left: Array
    speeds: Array
    torques: Array
    lags: list[schema.Lag]
    excitation: list[schema.JointExcitation]
    motion: tuple[Array, Array, Array]
    tau: Array
    work: TorqueWork


def _look_at_raw(raw: Staged, clock: RecordedTimes, limits: Limits | None) -> _Recorded:
    out = _Recorded([], [], [])
    some_missing = bool(clock.missing.any())
    for joint, name in enumerate(raw.joint_names):
        columns = raw.joint(joint)
        noise = {each: white_noise(columns[each], clock.part, robust=True) for each in ("tau", "dq") if each in columns}
        smooth = smoothed(columns["tau"], clock.part, noise["tau"])
        if some_missing:
            columns = {each: values[~clock.missing] for each, values in columns.items()}
        out.limits.append(against_limits(joint, name, columns, limits))
        out.saturation.append(saturation(joint, name, columns["q"], columns["tau"], limits))
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


def _share(level: float | None, values: Array) -> float | None:
    wide = spread(values)
    return None if level is None or wide == 0 else level / wide


def _look_at_samples(prepared: Prepared, limits: Limits | None) -> _Samples:
    staged, rate = prepared.staged, prepared.rate_hz
    part = number_parts(staged.rows, [np.diff(staged.read(EPISODE)) != 0])
    starts, ends = bounds(part)
    steps = None if rate is None else shifts(rate, int((ends - starts).max()))
    # figures on several joints together are taken over a few rows
    rows = thin(part, 2000, 0 if steps is None else int(steps[-1]))
    motion = (staged.table("q", rows), staged.table("dq", rows), staged.table("ddq", rows))
    tau = staged.table("tau", rows)
    fit = make_fit(rows, *motion, tau=tau, independent=_independent(prepared))
    lags = None if steps is None or rate is None else Lags(fit, steps, rate)
    ranges: dict[str, list[tuple[float, float]]] = {quantity: [] for quantity in QUANTITIES}
    levels, left, speeds, torques = np.empty((4, staged.n_joints))
    joint_lags, excitation, power = [], [], np.zeros(staged.rows)
    for joint, name in enumerate(staged.joint_names):
        columns = {quantity: staged.read(column(quantity, joint)) for quantity in QUANTITIES}
        for quantity, values in columns.items():
            ranges[quantity].append((float(values.min()), float(values.max())))
        levels[joint] = noise_or_share(columns["tau"], part)
        power += columns["tau"] * columns["dq"]
        speeds[joint], torques[joint] = np.sqrt(np.mean(columns["dq"] ** 2)), columns["tau"].std()
        if lags is None:
            left[joint] = np.sqrt(np.mean(fit.residuals(columns["tau"][rows, None]) ** 2))
        else:
            lag, left[joint] = lags.of_joint(name, columns["tau"])
            joint_lags.append(lag)
        excitation.append(joint_excitation(joint, name, columns, part, fit, float(left[joint]), limits))
    if lags is None:
        why = "no times were given" if rate is None else "the contiguous parts are too short"
        joint_lags = no_lags(staged.joint_names, why)
    else:
        joint_lags.insert(0, lags.of_all())
        for joint, name in enumerate(staged.joint_names):
            torque = staged.read(column("tau", joint))
            for lag in (joint_lags[0], joint_lags[joint + 1]):
                if clear(lag) and lags.lowers(torque, lag.seconds or 0.0):
                    lag.improves.append(name)
    return _Samples(
        ranges, levels.tolist(), left, speeds, torques, joint_lags, excitation, motion, tau, TorqueWork.of(power)
    )


def _independent(prepared: Prepared) -> float:
    """Samples that count as independent: after a low-pass two a period of its cut-off, else all."""
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
        profile.urdf, profile.name, names, limits, samples.motion, samples.tau, samples.left, independent, gravity
    )


def _excitation(samples: _Samples, rigid: RigidExcitation | str | None) -> schema.Excitation:
    """What motion alone says, and instead of its judgement of friction that beside rigid bodies where there are any."""
    if not isinstance(rigid, RigidExcitation):
        out = schema.Excitation(friction_beside="any motion", joints=samples.excitation, whole=None, text="")
    else:
        joints = [
            each.model_copy(
                update=weights(friction, speed, torque, min(each.forwards, each.backwards) < FRICTION.seldom)
            )
            for each, friction, speed, torque in zip(
                samples.excitation, rigid.friction, samples.speeds, samples.torques, strict=True
            )
        ]
        out = schema.Excitation(friction_beside="rigid bodies", joints=joints, whole=rigid.whole, text="")
    dq = samples.motion[1]
    out.standstill = float(np.mean(np.all(np.abs(dq) < SIGN_WIDTH, axis=1)))
    out.motion_dimensions = motion_dimensions(dq)
    out.text = in_words(out)
    return out


def _against_robot(
    robot: Profile | None, upload: Upload, signals: Signals, samples: _Samples, excitation: schema.Excitation
) -> tuple[schema.AgainstRobot | None, list[schema.Remedy]]:
    """Torque against that of the robot, given or suggested by the joints' names; and what is wrong."""
    bodies = None if robot is None else bodies_of(robot, upload.names)
    against = None if bodies is None else compare(bodies, signals)
    wrong = causes(upload, bodies, against, signals, excitation.joints, samples.work)
    return None if bodies is None or against is None else _figures(bodies, against), wrong


def _figures(bodies: Bodies, against: Against) -> schema.AgainstRobot:
    joints = []
    for joint, name in enumerate(bodies.names):
        # else a factor of it is one of rounding
        visible_parts = [bool(visible > 1e-3) for visible in against.visible[joint]]
        joints.append(
            schema.JointAgainstRobot(
                joint=name,
                gravity=finite(against.gravity[joint]) if visible_parts[0] else None,
                gravity_std=finite(against.gravity_std[joint]) if visible_parts[0] else None,
                inertia=finite(against.inertia[joint]) if visible_parts[1] else None,
                inertia_std=finite(against.inertia_std[joint]) if visible_parts[1] else None,
                explained=float(against.explained[joint]),
            )
        )
    return schema.AgainstRobot(robot=bodies.name, joints=joints)
