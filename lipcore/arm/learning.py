"""Learning an arm from samples: its geometry found, calibrated or taken as it is, then masses, friction and noise."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits
from torch import Tensor

from lipcore import noise
from lipcore.arm.problem import Expected, Point, Problem, root_of
from lipcore.arm.recording import residual_correlation
from lipcore.arm.scales import rescale
from lipcore.arm.search import Found, Pool, search
from lipcore.fit_options import FitOptions
from lipcore.fitting import Cancelled, FitCancelledError, FitProgress, Progress
from lipcore.kernels.arm_prior import (
    Alternative,
    Arm,
    arm_of_robot,
    chain,
    in_chain,
    unit_anywhere,
    widths_of,
)
from lipcore.kernels.compiled.arm import PARAMETERS
from lipcore.kernels.friction import FRICTION_TERMS, friction_features
from lipcore.kernels.geometry import Geometry
from lipcore.samples import Array, Samples
from lipcore.selection import spread_out
from lipcore.signals import noise_level
from lipcore.urdf import RigidBody
from lipcore.vocabulary import GeometryMode, JointType

SEARCH_ROWS, ROWS_PER_JOINT = 80, 10
"""Rows that the search looks at: at least the first, and this many a joint."""
POLISHED, POLISHING = 4, 40
"""Optima of few rows that are followed on all rows, and steps of that."""
ROUNDS, ROUND_STEPS = 3, 15
"""Times that scales and geometry are fitted in turn, and steps of each."""
NEAR = 7.0
"""nats: an arm that much less likely than the best counts for a thousandth."""
DIFFERS = 0.3
"""An alternative arm matters where its torque differs by this share of the spread that is stated anyway."""
CHECKS = 200
STRIBECK_NATS = 10.0
"""What a fourth term of friction has to gain to be kept. On simulated arms without such friction it lost two to seven,
a sign that turns over at once instead of smoothly gained seven, 0.5 N·m of such friction gained forty."""
STRIBECK_ROUNDS = 2
CORRELATED = 20_000
"""Contiguous rows at most that tell how correlated errors are."""


@dataclass(frozen=True)
class Learnt:
    """What was learnt. arm: its linearisation; params: hyperparameters of arm, friction and noise; rows: samples that
    it was learnt from; weight: independent samples that each of them stands for; report: for the manifest."""

    arm: Arm
    params: dict[str, Tensor]
    rows: NDArray[np.int64]
    weight: float
    report: dict[str, float | int | bool | str]


def learn(
    samples: Samples,
    joint_types: tuple[JointType, ...],
    options: FitOptions,
    gravity: bool = True,
    robot: RigidBody | None = None,
    known: Sequence[Geometry] = (),
    on_progress: Progress | None = None,
    cancelled: Cancelled | None = None,
    stretches: Samples | None = None,
    begin: Sequence[Geometry] = (),
    seed: int = 0,
) -> Learnt:
    """Learn the arm that moved so.

    gravity: whether torques contain it; robot: a URDF's bodies, which geometry and masses are expected around, as
    `options.geometry` and `options.prior` say; known: geometries to look at, too, where none is given; stretches:
    contiguous samples that tell the white noise, where `samples` are thinned; begin: geometries from base to tip that
    other samples of the same arm have told, which are followed from there, without a search; seed: of the search.

    Raise FitCancelledError when `cancelled` answers true, ValueError for samples that no arm can be learnt from.
    """
    with threadpool_limits(1):  # matrices are small: more threads would take longer
        watch = _Watch(on_progress, cancelled, time.monotonic(), options.max_iterations)
        mode = mode_of(options, robot)
        rows = spread_out(samples.motion(), options.posterior_samples).numpy()
        problem, order = make_problem(samples.rows(rows), joint_types, options, gravity, robot, samples)
        found: Found | None = None
        if mode == "learn" and not begin:
            few = spread_out(samples.rows(rows).motion(), max(SEARCH_ROWS, ROWS_PER_JOINT * len(joint_types)))
            types = tuple(joint_types[joint] for joint in order)
            signals = samples if stretches is None else stretches
            sensor = noise_level([signals.tau[part][:, order] for part in signals.episodes()])
            found = search(
                problem.rows(few.numpy()), types, gravity, sensor, options.search_seconds, seed, known, watch.searching
            )
            starts = [(each.geometry, each.sigma) for each in found.points[:POLISHED]]
        else:
            if robot is not None and (mode == "fixed" or not begin):
                begin = [Geometry.from_robot(robot, gravity)]
            starts = [(each, noise.start(samples)[order]) for each in begin]
        polished = Pool(problem.recombined(CHECKS))
        for geometry, sigma in starts:
            polished.add(problem.descend(geometry, sigma, POLISHING, watch.stop))
        ends = polished.points
        watch.step("hyperparameters", ends[0].value, 0.85)
        contiguous = (samples if stretches is None else stretches).rows(slice(0, CORRELATED))
        every, _ = make_problem(contiguous, joint_types, options, gravity, robot)
        residual = every.tau - every.features(ends[0].geometry) @ (problem.weights(ends[0]) / every.scale)
        correlation = residual_correlation(residual, contiguous)
        weight = min(1.0, len(samples) / correlation / len(rows))
        problem = replace(problem, counts=np.full(len(rows), weight))
        ends = sorted((problem.at(each.geometry, each.sigma) for each in ends), key=lambda each: each.value)
        best, others, problem, stribeck_nats = _refined(problem, ends, watch)
        watch.step("posterior", best.value, 0.95)
        report: dict[str, float | int | bool | str] = {"geometry": mode, "search_objective": ends[0].value}
        if found is not None:
            report |= _search_report(found, ends, others)
        report |= {
            "objective": best.value,
            "friction_terms": _terms(problem),
            "stribeck_nats": stribeck_nats,
            "iterations": watch.iteration,
            "converged": found is None or found.ended == "idle",
            "samples_given": len(samples),
            "samples_hyperparameters": len(rows),
            "samples_posterior": len(rows),
            "row_correlation": correlation,
            "seconds": time.monotonic() - watch.began,
            "device": "cpu",
        }
        arm, params = _arm(problem, best, others, order, mode)
        return Learnt(arm, params, rows, weight, report)


def mode_of(options: FitOptions, robot: RigidBody | None) -> GeometryMode:
    """How the geometry is to be come by; raise ValueError where that needs a robot and there is none."""
    if options.geometry == "auto":
        return "learn" if robot is None else "calibrate"
    if robot is None and options.geometry != "learn":
        raise ValueError(f"geometry is {options.geometry!r}, which needs a robot: a profile such as panda, or a URDF")
    return options.geometry


def make_problem(
    samples: Samples,
    joint_types: Sequence[JointType],
    options: FitOptions,
    gravity: bool,
    robot: RigidBody | None = None,
    every: Samples | None = None,
) -> tuple[Problem, NDArray[np.int64]]:
    """What samples ask of an arm, base to tip, and the data's joint at each place of the chain.

    every: all samples, which tell how large torques and noise are; `samples` where None.
    """
    mode, n, every = mode_of(options, robot), samples.n_joints, samples if every is None else every
    order = chain(robot, n)
    tau = in_chain(samples.tau, order)
    usual = np.sqrt(np.mean(every.tau**2, axis=0))[order]
    floor, start = noise.floor(every)[order], noise.start(every)[order]
    motions = np.stack([in_chain(part, order) for part in (samples.q, samples.dq, samples.ddq)], axis=1)
    speed = np.maximum(np.sqrt(np.mean(every.dq**2, axis=0))[order], 1e-3)
    # friction's weights of a joint, as large as its torque
    friction = np.stack([usual / speed, usual, usual], axis=1).reshape(-1) + floor.repeat(len(FRICTION_TERMS))
    anywhere = unit_anywhere(float(usual.max()), n)
    body, centre = anywhere, np.zeros((n, PARAMETERS))
    if robot is not None and mode != "learn":
        arm = arm_of_robot(robot, gravity, options.prior)
        masses, rotors = arm.unit[: PARAMETERS * n].reshape(n, -1), arm.unit[PARAMETERS * n :]
        body, centre = np.concatenate([masses[order].reshape(-1), rotors[order]]), arm.centre
    types = tuple(joint_types[joint] for joint in order)
    return (
        Problem(
            np.ascontiguousarray(motions),
            tau,
            np.ones(len(samples)),
            _friction(motions[:, 1]),
            np.concatenate([centre.reshape(-1), np.zeros(n + len(friction))]),
            np.concatenate([body, friction]),
            start,
            floor,
            _expected(types, gravity, robot, mode),
        ),
        order,
    )


def _expected(
    types: tuple[JointType, ...], gravity: bool, robot: RigidBody | None, mode: GeometryMode
) -> Expected | None:
    if mode == "fixed":
        return None
    if mode == "calibrate" and robot is not None:
        around = Geometry.from_robot(robot, gravity)
        return Expected(widths_of(around), around)
    n = len(types)
    any_arm = Geometry(
        types,
        np.tile(np.eye(3), (n, 1, 1)),
        np.zeros((n, 3)),
        np.tile([0.0, 0.0, 1.0], (n, 1)),
        np.array([0.0, 0.0, -1.0 if gravity else 0.0]),
    )
    return Expected.anything(any_arm)


def _refined(problem: Problem, ends: Sequence[Point], watch: _Watch) -> tuple[Point, list[Point], Problem, float]:
    """Scales, noise and geometry of the best end, with friction's fourth term where the evidence wants it; then what
    becomes of the other ends with the same scales; last how many nats that term gains."""
    best, problem = _in_turn(problem, ends[0], ROUNDS, 0.85, watch)
    wider = _with_stribeck(problem)
    start = wider.at(best.geometry, best.sigma)
    gain = rescale(problem, best).value - rescale(wider, start).value
    if gain > STRIBECK_NATS:
        best, problem = _in_turn(wider, start, STRIBECK_ROUNDS, 0.91, watch)
    others = []
    for end in ends[1:]:
        if end.value < ends[0].value + 2 * NEAR:
            other = problem.descend(end.geometry, best.sigma, ROUND_STEPS, watch.stop, noise=False)
            if other.value < best.value:
                best, other = other, best
            others.append(other)
    return best, [each for each in others if each.value < best.value + NEAR], problem, gain


def _in_turn(problem: Problem, point: Point, rounds: int, fraction: float, watch: _Watch) -> tuple[Point, Problem]:
    """Scales and noise, then geometry, in turn; fraction: of the work done before."""
    for number in range(rounds):
        scaled = rescale(problem, point)
        problem = scaled.problem
        point = problem.descend(point.geometry, scaled.sigma, ROUND_STEPS, watch.stop, noise=False)
        watch.step("hyperparameters", point.value, fraction + 0.02 * number)
    return point, problem


def _with_stribeck(problem: Problem) -> Problem:
    """The same with friction's fourth term, whose weights may be as large as a joint's torque, like the Coulomb ones
    before their scale was fitted."""
    n = problem.n_joints
    first, usual = (PARAMETERS + 1) * n, np.sqrt(np.mean(problem.tau**2, axis=0)) + problem.floor
    scale = np.concatenate([problem.scale[first:].reshape(n, -1), usual[:, None]], axis=1)
    return replace(
        problem,
        friction=_friction(problem.motions[:, 1], stribeck=True),
        centre=np.concatenate([problem.centre[:first], np.zeros(scale.size)]),
        scale=np.concatenate([problem.scale[:first], scale.reshape(-1)]),
    )


def _terms(problem: Problem) -> int:
    """Terms of a joint's friction, f."""
    return int(problem.friction.shape[2]) // problem.n_joints


def _arm(
    problem: Problem, best: Point, others: Sequence[Point], order: NDArray[np.int64], mode: GeometryMode
) -> tuple[Arm, dict[str, Tensor]]:
    n, place = problem.n_joints, np.argsort(order)
    first = (PARAMETERS + 1) * n
    body = problem.scale[: PARAMETERS * n].reshape(n, PARAMETERS)[place].reshape(-1)
    unit = np.concatenate([body, problem.scale[PARAMETERS * n : first][place]])
    friction = problem.scale[first:].reshape(n, -1)[place]
    params = {
        "rigid_body.log_scale": torch.zeros(4, dtype=torch.float64),
        "friction.log_std": torch.from_numpy(np.log(friction)),
        "noise.log_std": torch.from_numpy(np.log(best.sigma[place])),
    }
    expected = problem.expected
    arm = Arm(
        best.geometry,
        order,
        mode,
        problem.parameters(best),
        problem.centre[: PARAMETERS * n].reshape(n, PARAMETERS),
        unit,
        np.zeros(0) if expected is None else expected.step(best.geometry),
        np.zeros(0) if expected is None else expected.widths,
        _terms(problem) > len(FRICTION_TERMS),
    )
    differing = [each for each in others if _differs(problem, best, each)]
    if not differing:
        return arm, params
    chosen = [best, *differing[:3]]
    values = np.array([problem.laplace(each) for each in chosen])
    odds = np.exp(np.maximum(values.min() - values, -2 * NEAR))  # (none of zero: their covariance is to be factored)
    shares = odds / odds.sum()
    alternatives = tuple(
        _alternative(problem, each, place, float(share)) for each, share in zip(chosen, shares, strict=True)
    )
    return replace(arm, alternatives=alternatives), params


def _alternative(problem: Problem, point: Point, place: NDArray[np.int64], share: float) -> Alternative:
    n = problem.n_joints
    weights = problem.weights(point)
    first = (PARAMETERS + 1) * n
    rotor, friction = weights[PARAMETERS * n : first][place], weights[first:].reshape(n, -1)[place]
    return Alternative(point.geometry, problem.parameters(point), rotor, friction, share)


def _differs(problem: Problem, best: Point, other: Point) -> bool:
    """Whether two arms differ in torque beyond what is stated, where motions recombine those of the samples."""
    asked = problem.recombined(CHECKS)
    means = [asked.mean(point) for point in (best, other)]
    hessian, _, _ = problem.normal(best)
    root = root_of(hessian)
    both = asked.all_features(best)
    spread = np.square(np.linalg.solve(root, both.reshape(-1, both.shape[2]).T)).sum(0).reshape(means[0].shape)
    stated = np.sqrt(np.mean(spread, axis=0) + best.sigma**2)
    return bool(np.any(np.sqrt(np.mean((means[0] - means[1]) ** 2, axis=0)) > DIFFERS * stated))


def _search_report(found: Found, ends: Sequence[Point], others: Sequence[Point]) -> dict[str, float | int | bool | str]:
    report: dict[str, float | int | bool | str] = {
        "search_starts": found.starts,
        "search_hops": found.hops,
        "search_optima": found.distinct,
        "search_times_best": found.times_best,
        "search_explained": found.explained,
        "search_ended": found.ended,
        "search_seconds": found.seconds,
        "search_alternatives": len(others),
    }
    if len(ends) > 1:
        report["search_next_nats"] = ends[1].value - ends[0].value
    return report


def _friction(dq: Array, stribeck: bool = False) -> Array:
    """Friction's features of N velocities (N, n), joint by joint: (N, n, f n)."""
    size, n = dq.shape
    features = friction_features(torch.from_numpy(np.ascontiguousarray(dq)), stribeck).numpy()  # (f, N, n)
    out = np.zeros((size, n, n, len(features)))
    joints = np.arange(n)
    out[:, joints, joints] = features.transpose(1, 2, 0)
    return out.reshape(size, n, -1)


@dataclass
class _Watch:
    """Progress and cancellation."""

    on_progress: Progress | None
    cancelled: Cancelled | None
    began: float
    most: int
    iteration: int = 0

    def step(self, stage: str, objective: float, fraction: float) -> None:
        self.iteration += 1
        if self.stop():
            raise FitCancelledError("the fit was cancelled")
        if self.on_progress is not None:
            elapsed = time.monotonic() - self.began
            self.on_progress(FitProgress(stage, self.iteration, self.most, objective, fraction, elapsed))

    def searching(self, objective: float, fraction: float) -> None:
        self.step("geometry", objective, 0.8 * min(fraction, 1.0))

    def stop(self) -> bool:
        return self.cancelled is not None and self.cancelled()
