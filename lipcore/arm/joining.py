"""Several arms on one fixed base: each is learnt by itself, because their torques are independent, and then joined."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from lipcore.data.motion import Indices
from lipcore.data.samples import Array
from lipcore.estimators.hyperparameters import FitProgress, Progress
from lipcore.estimators.task import Task
from lipcore.kernels.arm_prior import Alternative, Arm, chain
from lipcore.kernels.drive.play import element_widths
from lipcore.kernels.drive.terms import check_kinds, drive_terms
from lipcore.kernels.fast.arm import PARAMETERS
from lipcore.kernels.geometry import Geometry
from lipcore.posterior.misfit import Misfit
from lipcore.vocabulary import DriveKind

if TYPE_CHECKING:
    from lipcore.arm.learning import ArmFit

UNUSED_SHARE = 1e-6
"""Prior standard deviation of a friction term that an arm does not have, as a share of that of its Coulomb term."""
MAX_ALTERNATIVES = 3
SUMS = (
    *("objective", "search_objective", "drive_nats", "zero_nats", "iterations", "seconds"),
    *("search_starts", "search_hops", "search_optima", "search_seconds", "search_alternatives"),
)
"""Entries of a report that are added; of MINIMA and MAXIMA, one is kept."""
MINIMA, MAXIMA = ("converged", "search_explained", "search_times_best", "search_next_nats"), ("base_tilt",)
_OF_JOINT = re.compile(r"(.*_)(\d+)")
Report = dict[str, float | int | bool | str]


def order_of(task: Task) -> Indices:
    """Return the data's joint at each place of the arms, arm after arm from base to tip, (n,)."""
    return chain(task.robot, task.samples.n_joints) if task.sibling is None else task.sibling.order


def split(task: Task) -> list[Task]:
    """Return the task of each arm, with its joints from base to tip."""
    parts = np.split(order_of(task), task.roots[1:])
    return [_part(task, number, joints, len(parts)) for number, joints in enumerate(parts)]


def _part(task: Task, number: int, joints: Indices, count: int) -> Task:
    return replace(
        task,
        samples=task.samples.joints(joints),
        joint_types=tuple(task.joint_types[joint] for joint in joints),
        options=replace(task.options, arms=""),
        robot=None if task.robot is None else task.robot.part(joints.tolist()),
        stretches=None if task.stretches is None else task.stretches.joints(joints),
        on_progress=None if task.on_progress is None else _of_part(task.on_progress, number, count),
        sibling=None if task.sibling is None else task.sibling.part(number),
    )


def _of_part(on_progress: Progress, number: int, count: int) -> Progress:
    def report(at: FitProgress) -> None:
        on_progress(replace(at, fraction=(number + at.fraction) / count))

    return report


def join(task: Task, fits: Sequence[ArmFit]) -> ArmFit:
    """Return the arms of a task in one, learnt from the same rows."""
    order = order_of(task)
    place, arms = np.argsort(order), [each.arm for each in fits]
    kinds = check_kinds(kind for arm in arms for kind in arm.drive)

    def of_data(parts: Sequence[Array]) -> Array:
        """Return arrays of the arms' joints, (n, …), in the order of the data."""
        return np.concatenate(parts)[place]

    sizes = [PARAMETERS * arm.n_joints for arm in arms]
    bodies = [arm.unit[:size].reshape(-1, PARAMETERS) for arm, size in zip(arms, sizes, strict=True)]
    rotors = [arm.unit[size:] for arm, size in zip(arms, sizes, strict=True)]
    acceleration = np.sqrt(np.mean(task.samples.ddq**2, axis=0)).clip(1e-3)
    arm = Arm(
        Geometry.joined([arm.geometry for arm in arms]),
        order,
        arms[0].mode,
        np.concatenate([arm.parameters for arm in arms]),
        np.concatenate([arm.centre for arm in arms]),
        np.concatenate([of_data(bodies).reshape(-1), of_data(rotors)]),
        of_data([arm.rotor for arm in arms]),
        np.concatenate([arm.expected for arm in arms]),
        np.concatenate([arm.widths for arm in arms]),
        kinds,
        acceleration if "play" in kinds else None,
        _alternatives(fits, kinds, place),
    )
    friction = [each.params["friction.log_std"] for each in fits]
    unused = [np.log(UNUSED_SHARE) + each[:, 1] for each in friction]
    widths = [_of_terms(each, arm.drive, kinds, none) for each, arm, none in zip(friction, arms, unused, strict=True)]
    params = {
        "rigid_body.log_scale": fits[0].params["rigid_body.log_scale"],
        "friction.log_std": of_data(widths),
        "noise.log_std": of_data([each.params["noise.log_std"] for each in fits]),
    }
    counts = of_data([each.counts.T for each in fits]).T
    report = _report(fits, order, kinds) | {"independent_samples": float(counts.mean(axis=1).sum())}
    return replace(
        fits[0],
        arm=arm,
        params=params,
        counts=counts,
        misfit=_misfit(fits).of_joints(place),
        report=report,
        likely=None,
    )


def _of_terms(values: Array, had: Sequence[DriveKind], kinds: Sequence[DriveKind], missing: Array) -> Array:
    """Return coefficients of friction, (n, f), with the terms of more kinds. missing: values of these, (n,)."""
    known = drive_terms(tuple(had))
    columns = [values[:, known.index(term)] if term in known else missing for term in drive_terms(tuple(kinds))]
    return np.stack(columns, axis=1)


def _alternatives(fits: Sequence[ArmFit], kinds: Sequence[DriveKind], place: Indices) -> tuple[Alternative, ...]:
    """Return the likeliest arms together, then those with one of them replaced; none if there is no alternative."""
    each: list[tuple[Alternative, ...]] = []
    for fit in fits:
        assert fit.likely is not None
        each.append(fit.arm.alternatives or (fit.likely,))
    if max(map(len, each)) == 1:
        return ()
    best = [options[0] for options in each]
    found = [[*best[:k], other, *best[k + 1 :]] for k, options in enumerate(each) for other in options[1:]]
    odds = [float(np.prod([one.probability for one in arms])) for arms in (best, *found)]
    ranked = sorted(zip(odds[1:], range(len(found)), strict=True), reverse=True)[:MAX_ALTERNATIVES]
    total = odds[0] + sum(share for share, _ in ranked)
    chosen = [(odds[0], best), *((share, found[k]) for share, k in ranked)]
    return tuple(_alternative(arms, fits, kinds, place, share / total) for share, arms in chosen)


def _alternative(
    arms: Sequence[Alternative], fits: Sequence[ArmFit], kinds: Sequence[DriveKind], place: Indices, share: float
) -> Alternative:
    friction = [
        _of_terms(arm.friction, fit.arm.drive, kinds, np.zeros(fit.arm.n_joints))
        for arm, fit in zip(arms, fits, strict=True)
    ]
    return Alternative(
        Geometry.joined([arm.geometry for arm in arms]),
        np.concatenate([arm.parameters for arm in arms]),
        np.concatenate([arm.rotor for arm in arms])[place],
        np.concatenate(friction)[place],
        share,
    )


def _misfit(fits: Sequence[ArmFit]) -> Misfit:
    """Return the misfit of all arms' joints. Arms without play have elements without torque."""
    packed = [fit.misfit for fit in fits]
    if any(each.elements.size for each in packed):
        for k, fit in enumerate(fits):
            if not packed[k].elements.size:
                widths = element_widths(fit.arm.joint_types)
                packed[k] = replace(packed[k], elements=np.stack([np.zeros_like(widths), widths]))
    return Misfit.unpacked(np.concatenate([each.packed() for each in packed], axis=1))


def _report(fits: Sequence[ArmFit], order: Indices, kinds: Sequence[DriveKind]) -> Report:
    """Return the report of all arms. Entries of a joint have its number in the data."""
    out: Report = {}
    first = 0
    for fit in fits:
        for key, value in fit.report.items():
            if (found := _OF_JOINT.fullmatch(key)) is not None:
                out[f"{found[1]}{order[first + int(found[2]) - 1] + 1}"] = value
            elif key not in out:
                out[key] = value
            else:
                out[key] = _together(key, out[key], value)
        first += fit.arm.n_joints
    return out | {"drive": ", ".join(kinds)}


def _together(key: str, one: Any, other: Any) -> Any:
    """Return an entry of two arms."""
    if key in SUMS:
        return one + other
    if key in MINIMA:
        return min(one, other)
    if key in MAXIMA or key == "search_ended":  # "time" is later than "idle" in the alphabet
        return max(one, other)
    return f"{one}, {other}" if key == "mounting" and one != other else one
