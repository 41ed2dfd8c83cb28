"""The kinds of friction, and gains, that a recording supports: chosen by the evidence, and by blocks that are held out.

Kinds of several terms need ten seconds of motion, gains six. Kinds are added one after another. Each time the kind with
the largest gain in evidence is added, if

- it gains at least `min_nats`, with several terms `min_nats_of_several`, for all joints or for those that are predicted
  better with it, and
- blocks of the recording are predicted better from the other blocks, beyond their scatter, and
- friction does not fall with the load, nor play elements push a joint, beyond doubt.

The evidence alone trusts a recording in which joints move together too much; held-out blocks do not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve

from lipcore.arm.posing import with_kind
from lipcore.arm.problem import Point, Problem, root_of
from lipcore.arm.scales import ScaleFit, rescale
from lipcore.data.samples import Array
from lipcore.kernels.drive.terms import KIND_TERMS
from lipcore.kernels.fast.play import POSITIONS
from lipcore.vocabulary import DRIVE_KINDS, DriveKind


@dataclass(frozen=True)
class DriveOptions:
    """Limits of the choice."""

    kinds: tuple[DriveKind, ...] = DRIVE_KINDS
    """Kinds that may be added."""
    min_nats: float = 3.0
    """Min gain in evidence: odds of twenty to one, from independent samples. On simulated arms without low-speed
    friction that kind lost two to seven nats if every row counted."""
    min_nats_of_several: float = 4.0
    """The same for kinds of several terms, with several scales to fit. On two simulated arms without such friction they
    gained 3.1 and 3.3 nats; on a UR10 at least 4.1."""
    min_samples: float = 9.9
    """Min effective samples for kinds of several terms. Tuned on a UR10: with 5 s of motion, the coverage of one joint
    fell from 98 to 76 %; with 10 s, none fell below 96 %."""
    min_samples_of: Mapping[DriveKind, float] = field(default_factory=lambda: {"gain": 6.0, "position": 20.0})
    """The same for these kinds. Gains: on the UR10 with five effective samples, the coverage of one joint fell from 79
    to 41 %. Torque that repeats over a turn: on a KUKA with ten, the error of one joint rose fivefold."""
    blocks: int = 8
    """Blocks of the recording, each predicted from the others."""
    min_deviations: float = 1.0
    """Min mean gain over the blocks, the logarithm of the squared error, in its standard deviations."""
    min_turn_rad: float = float(np.pi)
    """Min range of a joint with torque that repeats over a turn: half a turn."""
    min_deviations_of_position: float = 4.0
    """The same as `min_deviations` for such a joint. Tuned on a Panda (24 s): joint 5 gained 3.4 deviations and was
    predicted worse afterwards, joint 7 gained 6 to 9 and was predicted better."""
    max_doubt: float = 2.0
    """Standard deviations below zero at which a coefficient of the load, or the sum of the play elements, is
    implausible."""


OPTIONS = DriveOptions()


@dataclass(frozen=True)
class DriveChoice:
    """Result of `choose_drive`."""

    problem: Problem
    """The problem with the chosen kinds."""
    point: Point
    """The same geometry in it."""
    nats: float
    """Gain in evidence of all chosen kinds."""


def choose_drive(problem: Problem, point: Point, rows: NDArray[np.int64], stop: Callable[[], bool]) -> DriveChoice:
    """Add the kinds of friction that the samples support.

    rows: of the recording, (N,), the problem's samples in order of time; stop: called at every step. Raise LinAlgError
    if an evidence cannot be computed.
    """
    blocks = np.empty(len(rows), np.int64)
    blocks[np.argsort(rows, kind="stable")] = np.arange(len(rows)) * OPTIONS.blocks // len(rows)
    best, gain = rescale(problem, point), 0.0
    errors = held_out_errors(best.problem, best.point, blocks)
    samples = float(problem.counts.mean(axis=1).sum())
    remembers = problem.motions.shape[1] > POSITIONS
    open_kinds = [kind for kind in OPTIONS.kinds if samples >= _min_samples(kind) and (remembers or kind != "play")]
    while open_kinds and not stop():
        trials = [(_fit_kind(best, point, kind), kind) for kind in open_kinds]
        likely = [each for each in trials if each[0].value < best.value]
        for trial, kind in sorted(likely, key=lambda each: each[0].value):
            chosen = _choose_joints(best, trial, point, kind, errors, blocks)
            if chosen is not None:
                gain += best.value - chosen.fit.value
                best, errors = chosen.fit, chosen.errors
                open_kinds.remove(kind)
                break
        else:
            break
    return DriveChoice(best.problem, best.point, gain)


@dataclass(frozen=True)
class _Chosen:
    """A kind that is added."""

    fit: ScaleFit
    errors: Array
    """Held-out errors, (B, n) (N·m)²."""


def _fit_kind(best: ScaleFit, point: Point, kind: DriveKind, joints: NDArray[np.bool_] | None = None) -> ScaleFit:
    """Return the fit with another kind. joints: (n,), those that have it; None for all."""
    joints = np.ones(best.problem.n_joints, np.bool_) if joints is None else joints
    wider = with_kind(best.problem, best.point, kind, joints)
    return rescale(wider, wider.at(point.geometry, point.sigma))


def _choose_joints(
    best: ScaleFit, trial: ScaleFit, point: Point, kind: DriveKind, errors: Array, blocks: NDArray[np.int64]
) -> _Chosen | None:
    """Return the fit with a kind; None if it is to be left out.

    The joints have it that are predicted better with it, or all if that has the higher evidence. Torque that repeats
    over a turn is only for joints that turn far enough to show it. trial: with the kind for all joints; errors:
    held-out errors without it.
    """
    wider = held_out_errors(trial.problem, trial.point, blocks)
    joints, repeats = _is_better(errors, wider), kind == "position"
    if repeats:
        turned = np.ptp(best.problem.motions[:, 0], axis=0) > OPTIONS.min_turn_rad
        joints = turned & _is_better(errors, wider, deviations=OPTIONS.min_deviations_of_position)
        if not joints.any():
            return None
    if joints.any() and not joints.all():
        fewer = _fit_kind(best, point, kind, joints)
        if fewer.value < trial.value or repeats:
            trial, wider = fewer, held_out_errors(fewer.problem, fewer.point, blocks)
    supported = best.value - trial.value >= _min_nats(kind) and not _is_implausible(trial.problem, trial.point)
    return _Chosen(trial, wider) if supported and _is_better(errors, wider, together=True) else None


def _min_samples(kind: DriveKind) -> float:
    """Return the min effective samples of a kind."""
    if kind in OPTIONS.min_samples_of:
        return OPTIONS.min_samples_of[kind]
    return OPTIONS.min_samples if len(KIND_TERMS[kind]) > 1 else 0.0


def _min_nats(kind: DriveKind) -> float:
    """Return the min gain in evidence of a kind."""
    return OPTIONS.min_nats if len(KIND_TERMS[kind]) == 1 else OPTIONS.min_nats_of_several


def _is_better(
    before: Array, after: Array, together: bool = False, deviations: float = OPTIONS.min_deviations
) -> NDArray[np.bool_]:
    """Return whether held-out errors of B blocks, (B, n), fall beyond their scatter, (n,) or all `together`."""
    least = np.finfo(float).tiny
    gains = np.log(np.maximum(before, least)) - np.log(np.maximum(after, least))
    gains = gains.mean(axis=1) if together else gains
    return np.asarray(gains.mean(axis=0) > deviations * gains.std(axis=0, ddof=1) / np.sqrt(len(gains)))


def held_out_errors(problem: Problem, point: Point, blocks: NDArray[np.int64]) -> Array:
    """Return the mean squared error of each joint in B blocks predicted from the others, (B, n) (N·m)².

    The torque is linear in all unknowns around the point, so one step from it fits the others. blocks: (N,), each
    sample's block.
    """
    out = []
    for held in (blocks == block for block in np.unique(blocks)):
        of_others, of_held = (replace(point, features=point.features[rows]) for rows in (~held, held))
        hessian, gradient, _ = problem.rows(~held).normal(of_others)
        step = cho_solve((root_of(hessian), True), gradient, check_finite=False)
        block = problem.rows(held)
        both = np.concatenate([of_held.features, block.shapes(of_held)], axis=2)
        out.append(np.square(block.residual(of_held) - both @ step).mean(axis=0))
    return np.array(out)


def _is_implausible(problem: Problem, point: Point) -> bool:
    """Return whether a joint's friction falls with the load, or its play elements push it, beyond doubt."""
    n, terms = problem.n_joints, problem.drive.terms
    covariance = cho_solve((point.factor, True), np.eye(len(problem.scale)), check_finite=False)
    covariance = covariance[problem.bodies :, problem.bodies :] * np.outer(*2 * [problem.scale[problem.bodies :]])
    weights = problem.weights(point)[problem.bodies :].reshape(n, -1)
    for summed in (["load"], KIND_TERMS["play"]):
        row = np.array([float(term in summed) for term in terms])
        for joint in np.flatnonzero(problem.used @ row):
            places = len(terms) * joint + np.arange(len(terms))
            deviation = np.sqrt(row @ covariance[np.ix_(places, places)] @ row)
            if weights[joint] @ row < -OPTIONS.max_doubt * deviation:
                return True
    return False
