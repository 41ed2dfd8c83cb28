"""Learning of an arm from samples: its geometry (searched, calibrated or fixed), then masses, friction and noise."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from lipcore.arm import joining, right_angles
from lipcore.arm.drive import choose_drive
from lipcore.arm.mounting import Mounting, find_mounting
from lipcore.arm.posing import make_problem, mode_of, surroundings, with_load, with_samples
from lipcore.arm.problem import WIDTHS, Point, Problem, root_of
from lipcore.arm.right_angles import Candidate, Layout
from lipcore.arm.scales import rescale
from lipcore.arm.search import Pool, SearchResult, known_geometries, search
from lipcore.data.motion import Motion
from lipcore.data.samples import Array, Samples
from lipcore.data.signals import noise_level
from lipcore.estimators import noise
from lipcore.estimators.hyperparameters import FitCancelledError, FitProgress
from lipcore.estimators.task import Task
from lipcore.kernels.arm_prior import Alternative, Arm, chain
from lipcore.kernels.drive.terms import passing_row
from lipcore.kernels.fast.arm import PARAMETERS
from lipcore.kernels.fast.play import POSITIONS
from lipcore.kernels.geometry import Geometry
from lipcore.model.selection import MAX_TEXT_LENGTH
from lipcore.model.texts import list_joints
from lipcore.posterior.misfit import Misfit, estimate_misfit, shared_rows
from lipcore.posterior.selection import spread_out
from lipcore.vocabulary import GeometryMode


@dataclass(frozen=True)
class ArmOptions:
    """Effort of learning an arm, and min gains of its friction term and its alternatives."""

    min_search_rows: int = 80
    search_rows_per_joint: int = 10
    """Rows of the search: this many per joint, at least the min."""
    polished: int = 4
    """Optima of the search that are improved on all rows."""
    polish_steps: int = 40
    rounds: int = 3
    round_steps: int = 15
    """Alternations between the fits of scales and geometry, and steps of each."""
    min_difference: float = 0.3
    """Min difference in torque of an alternative arm, as a share of the stated spread."""
    check_motions: int = 200
    """Motions at which arms are compared."""
    drive_rounds: int = 2
    rest_rounds: int = 2
    max_contiguous_rows: int = 20_000
    """Max contiguous rows for the estimate of the lasting part of the errors."""


OPTIONS = ArmOptions()


@dataclass(frozen=True)
class ArmFit:
    """A learnt arm."""

    arm: Arm
    """The arm, linearised."""
    params: dict[str, Array]
    """Hyperparameters of arm, friction and noise."""
    rows: NDArray[np.int64]
    """Indices of the samples that it was learnt from."""
    counts: Array
    """Independent measurements that each torque of these rows represents, (rows, n)."""
    misfit: Misfit
    """Variance that the arm does not model."""
    report: dict[str, float | int | bool | str]
    """Report for the manifest."""
    likely: Alternative | None = None
    """The arm at its most likely parameters, of one arm."""


def learn(
    task: Task,
    known: Sequence[Geometry] = (),
    begin: Sequence[Geometry] = (),
    seed: int = 0,
) -> ArmFit:
    """Learn the arm from the samples of a task, or several arms on one base.

    task.robot, task.sibling: bodies of a URDF, or the arm of another unit, as the prior of geometry and masses
    according to `options.geometry` and `options.prior`; known: additional start geometries of a search, without robot
    and sibling; begin: geometries from other samples of the same arm, base to tip, which are improved without a search;
    seed: of the search.

    Raise FitCancelledError when `task.cancelled` returns true, ValueError for samples that no arm can be learnt from.
    """
    rows = spread_out(task.samples.motion(), task.options.posterior_samples)
    known, begin = ([each for each in shapes if each.roots == task.roots] for shapes in (known, begin))
    with threadpool_limits(1):  # matrices are small: more threads would be slower
        if len(task.roots) == 1:
            fit = _learn_arm(task, rows, known, begin, seed)
        else:
            fits = []
            for number, part in enumerate(joining.split(task)):
                shapes, starts = ([each.arms[number][2] for each in several] for several in (known, begin))
                if task.robot is None and task.sibling is None:
                    shapes += known_geometries(part.joint_types, task.gravity)
                fits.append(_learn_arm(part, rows, shapes, starts, seed))
            fit = joining.join(task, fits)
    return replace(fit, report={**fit.report, **_joints_report(task)})


def _learn_arm(
    task: Task, rows: NDArray[np.int64], known: Sequence[Geometry], begin: Sequence[Geometry], seed: int
) -> ArmFit:
    """Learn one arm from these rows of a task, see `learn`."""
    samples, watch = task.samples, _Watch(task, time.monotonic())
    mode, around = mode_of(task), surroundings(task)
    order = chain(task.robot, samples.n_joints) if around is None else around.order
    chosen = samples.rows(rows)
    problem = make_problem(chosen, task.joint_types, order, task.gravity, around, samples)
    if task.sibling is not None:
        problem = replace(problem, scale_width=WIDTHS.unit)
    urdf = mode == "calibrate" and task.sibling is None
    result: SearchResult | None = None
    if mode == "learn" and not begin:
        result = _search(task, problem, order, chosen, known, seed, watch)
        starts = [(each.geometry, each.sigma) for each in result.points[: OPTIONS.polished]]
    else:
        if around is not None and (mode == "fixed" or not begin or urdf):
            begin = [around.geometry]
        level = noise.start(samples)[order]
        starts = [(each, level) for each in begin]
    polished = Pool(problem.recombined(OPTIONS.check_motions))
    for geometry, sigma in starts:
        polished.add(problem.descend(geometry, sigma, OPTIONS.polish_steps, watch.stop))
    ends = polished.points
    watch.step("hyperparameters", ends[0].value, 0.85)
    counting = _Counting(
        task.contiguous(OPTIONS.max_contiguous_rows), order, shared_rows(samples, task.joint_types, len(rows))
    )
    problem = counting.applied(problem, ends[0], at_rest=False)
    ends = sorted((problem.at(each.geometry, each.sigma) for each in ends), key=lambda each: each.value)
    mounting: Mounting | None = None
    if urdf:
        mounting = find_mounting(problem, ends[0], OPTIONS.polish_steps, watch.stop)
        problem, ends = mounting.problem, [mounting.point]
    found, drive_nats = _refine(problem, ends, counting, watch, known if mode == "learn" else None, rows)
    best, problem = found[0].point, found[0].problem
    misfit, _ = counting.misfit(problem, best, best.sigma**2)
    watch.step("posterior", best.value, 0.95)
    report: dict[str, float | int | bool | str] = {"geometry": mode, "search_objective": ends[0].value}
    if result is not None:
        report |= _search_report(result, ends, found)
    report |= {
        "objective": best.value,
        "drive": ", ".join(problem.drive.kinds),
        "drive_nats": drive_nats,
        "iterations": watch.iteration,
        "converged": result is None or result.ended == "idle",
        "samples_given": len(samples),
        "samples_hyperparameters": len(rows),
        "samples_posterior": len(rows),
        "independent_samples": float(problem.counts.mean(axis=1).sum()),
        "seconds": time.monotonic() - watch.began,
        "device": "cpu",
    }
    if mounting is not None:
        report |= mounting.report(best.geometry, order)
    if mode == "learn":
        sure = right_angles.right_angle_probabilities(found)[np.argsort(order)]
        report |= {f"right_angle_{joint + 1}": round(float(each), 3) for joint, each in enumerate(sure)}
    arm, params = _arm(found, order, mode)
    place, n = np.argsort(order), problem.n_joints
    friction = problem.weights(best)[problem.bodies :].reshape(n, -1)
    misfit = misfit.with_friction(friction @ passing_row(problem.drive.kinds)).of_joints(place)
    likely = _alternative(problem, best, place, 1.0)
    return ArmFit(arm, params, rows, problem.counts[:, place], misfit, report, likely)


@dataclass(frozen=True)
class _Counting:
    """Weights of torques from the lasting part of their errors."""

    contiguous: Samples
    """Contiguous samples."""
    order: NDArray[np.int64]
    """The data's joint at each place of the chain, (n,)."""
    shared: float
    """Rows of a problem that share one lasting error."""

    def applied(self, problem: Problem, point: Point, at_rest: bool) -> Problem:
        """Return the problem with torques weighted by a point's residuals.

        at_rest: include unknown friction at rest.
        """
        misfit, noise = self.misfit(problem, point)
        misfit = misfit if at_rest else replace(misfit, rest=np.zeros_like(misfit.rest))
        variance = misfit.of_row(noise, Motion.of(problem.motions), self.shared)
        return replace(problem, counts=noise / variance)

    def misfit(self, problem: Problem, point: Point, least: Array | float = 0.0) -> tuple[Misfit, Array]:
        """Return `estimate_misfit` of a point's residuals on contiguous samples, base to tip."""
        recorded = with_samples(problem, self.contiguous, self.order)
        residual, moved = recorded.tau - recorded.mean(point), recorded.motions[:, 1:POSITIONS].swapaxes(0, 1)
        misfit, noise = estimate_misfit(residual, recorded.tau, moved, self.contiguous.episodes(), least)
        if problem.drive.elements is not None:
            widths = problem.drive.elements.widths
            friction = problem.weights(point)[problem.bodies :].reshape(problem.n_joints, -1)
            misfit = replace(misfit, elements=np.stack([np.abs(friction[:, -len(widths) :]).T, widths]))
        return misfit, noise


def _search(
    task: Task,
    problem: Problem,
    order: NDArray[np.int64],
    samples: Samples,
    known: Sequence[Geometry],
    seed: int,
    watch: _Watch,
) -> SearchResult:
    """Search for the geometry on a few of the rows `samples` of a problem."""
    types = tuple(task.joint_types[joint] for joint in order)
    few = spread_out(samples.motion(), max(OPTIONS.min_search_rows, OPTIONS.search_rows_per_joint * len(types)))
    sensor = noise_level([task.signals.tau[part][:, order] for part in task.signals.episodes()])
    seconds = task.options.search_seconds
    return search(problem.rows(few), types, task.gravity, sensor, seconds, seed, known, watch.searching)


def _refine(
    problem: Problem,
    ends: Sequence[Point],
    counting: _Counting,
    watch: _Watch,
    known: Sequence[Geometry] | None,
    rows: NDArray[np.int64],
) -> tuple[list[Candidate], float]:
    """Return the most likely arm with those nearly as likely, and the gain in nats of the drive's kinds.

    All have the scales, the noise and the drive of the first. known: geometries for the search for right angles, if
    the geometry is learnt without a prior; else None; rows: (N,), the problem's samples in order of time.
    """
    best, problem = _alternate(problem, ends[0], OPTIONS.rounds, 0.85, watch)
    free: Layout = (None,) * problem.n_joints
    others = [end for end in ends[1:] if end.value < ends[0].value + 2 * right_angles.OPTIONS.near_nats]
    starts = [(free, problem.expected, end) for end in (best, *others)]
    if known is not None:
        chosen = right_angles.likely_layouts(problem, [best, *ends[1:]], known, watch.stop)
        starts = [*((each.layout, each.problem.expected, each.point) for each in chosen), *starts]
        problem = replace(problem, expected=starts[0][1])
        best, problem = _alternate(problem, starts[0][2], OPTIONS.drive_rounds, 0.87, watch)
    choice = choose_drive(problem, best, rows, watch.stop)
    if choice.problem.drive.kinds:
        best, problem = _alternate(choice.problem, choice.point, OPTIONS.drive_rounds, 0.88, watch)
    for number in range(OPTIONS.rest_rounds):
        problem = counting.applied(with_load(problem, best), best, at_rest=True)
        best, problem = _alternate(
            problem, problem.at(best.geometry, best.sigma), OPTIONS.drive_rounds, 0.9 + 0.02 * number, watch
        )
    found = [right_angles.weigh(problem, best, starts[0][0])]
    for layout, expected, other in starts[1:]:
        posed = replace(problem, expected=expected)
        end = posed.descend(other.geometry, best.sigma, OPTIONS.round_steps, watch.stop, noise=False)
        found.append(right_angles.weigh(posed, end, layout))
    found.sort(key=lambda each: each.evidence)
    return [each for each in found if each.evidence < found[0].evidence + right_angles.OPTIONS.near_nats], choice.nats


def _alternate(problem: Problem, point: Point, rounds: int, fraction: float, watch: _Watch) -> tuple[Point, Problem]:
    """Fit scales and noise, then geometry, in turn. fraction: of the work done before."""
    for number in range(rounds):
        scaled = rescale(problem, point)
        problem = scaled.problem
        point = problem.descend(point.geometry, scaled.point.sigma, OPTIONS.round_steps, watch.stop, noise=False)
        watch.step("hyperparameters", point.value, fraction + 0.01 * number)
    return point, problem


def _arm(found: Sequence[Candidate], order: NDArray[np.int64], mode: GeometryMode) -> tuple[Arm, dict[str, Array]]:
    """Return the arm of the most likely candidate, with the others that predict different torques."""
    problem, best = found[0].problem, found[0].point
    n, place = problem.n_joints, np.argsort(order)
    first = problem.bodies
    body = problem.scale[: PARAMETERS * n].reshape(n, PARAMETERS)[place].reshape(-1)
    unit = np.concatenate([body, problem.scale[PARAMETERS * n : first][place]])
    friction = problem.scale[first:].reshape(n, -1)[place]
    params = {
        "rigid_body.log_scale": np.zeros(4),
        "friction.log_std": np.log(friction),
        "noise.log_std": np.log(best.sigma[place]),
    }
    expected = problem.expected
    arm = Arm(
        best.geometry,
        order,
        mode,
        problem.parameters(best),
        problem.centre[: PARAMETERS * n].reshape(n, PARAMETERS),
        unit,
        problem.centre[PARAMETERS * n : first][place],
        np.zeros(0) if expected is None else expected.step(best.geometry),
        np.zeros(0) if expected is None else expected.widths,
        problem.drive.kinds,
        None if problem.drive.elements is None else problem.drive.elements.acceleration[place],
    )
    differing = [each for each in found[1:] if _differs(problem, best, each.point)]
    if not differing:
        return arm, params
    chosen = [found[0], *differing[:3]]
    shares = right_angles.candidate_probabilities(chosen)
    alternatives = tuple(
        _alternative(each.problem, each.point, place, float(share)) for each, share in zip(chosen, shares, strict=True)
    )
    return replace(arm, alternatives=alternatives), params


def _alternative(problem: Problem, point: Point, place: NDArray[np.int64], share: float) -> Alternative:
    n = problem.n_joints
    weights, first = problem.weights(point), problem.bodies
    rotor, friction = weights[PARAMETERS * n : first][place], weights[first:].reshape(n, -1)[place]
    return Alternative(point.geometry, problem.parameters(point), rotor, friction, share)


def _differs(problem: Problem, best: Point, other: Point) -> bool:
    """Return whether two arms differ in torque beyond the stated uncertainty, at recombined motions of the samples."""
    asked = problem.recombined(OPTIONS.check_motions)
    means = [asked.mean(point) for point in (best, other)]
    hessian, _, _ = problem.normal(best)
    root = root_of(hessian)
    both = asked.all_features(best)
    spread = np.square(np.linalg.solve(root, both.reshape(-1, both.shape[2]).T)).sum(0).reshape(means[0].shape)
    stated = np.sqrt(np.mean(spread, axis=0) + best.sigma**2)
    return bool(np.any(np.sqrt(np.mean((means[0] - means[1]) ** 2, axis=0)) > OPTIONS.min_difference * stated))


def _joints_report(task: Task) -> dict[str, str | int]:
    """Return the number of several arms, and the joints of the URDF that the data lack, such as those of a gripper."""
    report: dict[str, str | int] = {"arms": len(task.roots)} if len(task.roots) > 1 else {}
    if task.robot is not None and task.robot.fixed_joints:
        report["fixed_joints"] = list_joints(task.robot.fixed_joints)[:MAX_TEXT_LENGTH]
    if task.robot is not None and task.robot.followers:
        pairs = (f"{each.joint} follows {each.leader}" for each in task.robot.followers)
        report["followed_joints"] = ", ".join(pairs)[:MAX_TEXT_LENGTH]
    return report


def _search_report(
    result: SearchResult, ends: Sequence[Point], found: Sequence[Candidate]
) -> dict[str, float | int | bool | str]:
    report: dict[str, float | int | bool | str] = {
        "search_starts": result.starts,
        "search_hops": result.hops,
        "search_optima": result.distinct,
        "search_times_best": result.times_best,
        "search_explained": result.explained,
        "search_ended": result.ended,
        "search_seconds": result.seconds,
        "search_alternatives": len(found) - 1,
    }
    if len(ends) > 1:
        report["search_next_nats"] = ends[1].value - ends[0].value
    return report


class _Watch:
    """Progress and cancellation of a task."""

    def __init__(self, task: Task, began: float) -> None:
        self.task, self.began, self.iteration = task, began, 0

    def step(self, stage: str, objective: float, fraction: float) -> None:
        """Report a step. Raise FitCancelledError if the caller has cancelled."""
        self.iteration += 1
        if self.stop():
            raise FitCancelledError("the fit was cancelled")
        if self.task.on_progress is not None:
            most, elapsed = self.task.options.max_iterations, time.monotonic() - self.began
            self.task.on_progress(FitProgress(stage, self.iteration, most, objective, fraction, elapsed))

    def searching(self, objective: float, fraction: float) -> None:
        """Report a step of the search, the longest part of the work."""
        self.step("geometry", objective, 0.8 * min(fraction, 1.0))

    def stop(self) -> bool:
        """Return whether the caller has cancelled."""
        return self.task.cancelled is not None and self.task.cancelled()
