"""The kinds of friction that a recording supports: chosen by the evidence, and by blocks that are held out.

Kinds of several terms need ten seconds of motion. Kinds are added one after another. Each time the kind with the
largest gain in evidence is added, if

- it gains at least `min_nats`, with several terms `min_nats_of_several`, and
- blocks of the recording are predicted better from the other blocks, beyond their scatter, and
- friction does not fall with the load, beyond doubt.

The evidence alone trusts a recording in which joints move together too much; held-out blocks do not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve

from lipcore.arm.posing import with_kind
from lipcore.arm.problem import Point, Problem, root_of
from lipcore.arm.scales import ScaleFit, rescale
from lipcore.data.samples import Array
from lipcore.kernels.drive.terms import KIND_TERMS
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
    blocks: int = 8
    """Blocks of the recording, each predicted from the others."""
    min_deviations: float = 1.0
    """Min mean gain over the blocks, the logarithm of the squared error, in its standard deviations."""
    max_doubt: float = 2.0
    """Standard deviations below zero at which a coefficient of the load is implausible."""


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
    before, gain = rescale(problem, point), 0.0
    samples = float(problem.counts.mean(axis=1).sum())
    open_kinds = [kind for kind in OPTIONS.kinds if samples >= OPTIONS.min_samples or len(KIND_TERMS[kind]) == 1]
    while open_kinds and not stop():
        trials: list[tuple[float, DriveKind, ScaleFit]] = []
        for kind in open_kinds:
            wider = with_kind(before.problem, before.point, kind)
            trial = rescale(wider, wider.at(point.geometry, point.sigma))
            trials.append((before.value - trial.value, kind, trial))
        trials.sort(key=lambda each: -each[0])
        accepted = next(
            (each for each in trials if each[0] >= _min_nats(each[1]) and _is_supported(before, each[2], rows)), None
        )
        if accepted is None:
            break
        gain += accepted[0]
        before = accepted[2]
        open_kinds.remove(accepted[1])
    return DriveChoice(before.problem, before.point, gain)


def _min_nats(kind: DriveKind) -> float:
    """Return the min gain in evidence of a kind."""
    return OPTIONS.min_nats if len(KIND_TERMS[kind]) == 1 else OPTIONS.min_nats_of_several


def _is_supported(before: ScaleFit, after: ScaleFit, rows: NDArray[np.int64]) -> bool:
    """Return whether a wider problem predicts held-out blocks better, with plausible coefficients of the load."""
    if _falls_with_load(after.problem, after.point):
        return False
    blocks = np.empty(len(rows), np.int64)
    blocks[np.argsort(rows, kind="stable")] = np.arange(len(rows)) * OPTIONS.blocks // len(rows)
    errors = [held_out_errors(each.problem, each.point, blocks) for each in (before, after)]
    gains = np.log(errors[0] / errors[1]).mean(axis=1)
    return bool(gains.mean() > OPTIONS.min_deviations * gains.std(ddof=1) / np.sqrt(len(gains)))


def held_out_errors(problem: Problem, point: Point, blocks: Sequence[int] | NDArray[np.int64]) -> Array:
    """Return the mean squared error of each joint in B blocks predicted from the others, (B, n) (N·m)².

    The torque is linear in all unknowns around the point. blocks: (N,), each sample's block.
    """
    blocks = np.asarray(blocks)
    weight = np.sqrt(problem.counts) / point.sigma
    both = np.concatenate([point.features, problem.shapes(point)], axis=2)
    target = problem.tau - both[:, :, : len(problem.scale)] @ (problem.centre / problem.scale)
    prior, size = np.ones(both.shape[2]), both.shape[2]
    steps = np.zeros(size)
    if problem.expected is not None:
        prior[len(problem.scale) :] = problem.expected.widths**-2.0
        steps[len(problem.scale) :] = prior[len(problem.scale) :] * problem.expected.step(point.geometry)
    flat, right = both * weight[:, :, None], target * weight
    names = np.unique(blocks)
    parts = [(flat[blocks == each].reshape(-1, size), right[blocks == each].reshape(-1)) for each in names]
    grams = [(rows.T @ rows, rows.T @ values) for rows, values in parts]
    total, total_right = sum(gram for gram, _ in grams) + np.diag(prior), sum(each for _, each in grams) + steps
    out = np.empty((len(names), problem.n_joints))
    for at, (gram, each) in enumerate(grams):
        mean = cho_solve((root_of(total - gram), True), total_right - each, check_finite=False)
        mine = blocks == names[at]
        out[at] = np.square(target[mine] - both[mine] @ mean).mean(axis=0)
    return out


def _falls_with_load(problem: Problem, point: Point) -> bool:
    """Return whether the friction of a joint falls with the load, beyond doubt."""
    terms = list(problem.drive.names)
    if "load" not in terms:
        return False
    places = problem.bodies + terms.index("load") + len(terms) * np.arange(problem.n_joints)
    covariance = cho_solve((point.factor, True), np.eye(len(problem.scale)), check_finite=False)
    deviation = np.sqrt(covariance.diagonal()[places])
    return bool((point.weights[places] < -OPTIONS.max_doubt * deviation).any())
