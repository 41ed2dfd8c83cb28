"""How a recording was moved, and how well that would tell friction and a robot's inertial parameters.

A friction weight's standard deviation is that of least squares with the noise that the fit leaves, over as many
independent rows as the recording has: two a period of the low-pass. It is judged by the torque it stands for (viscous:
at the usual speed) as a share of the spread of the joint's torque, see FrictionOptions.

Rigid bodies are judged by the regressor of the robot's URDF at few rows, against that of random motion over its whole
range. In coordinates in which random motion excites every base parameter by 1, the recording excites some more and some
less; the least excited one limits what can be identified.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.extras import MissingExtraError
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.arm_prior import arm_of_robot
from lipcore.kernels.friction import FRICTION_TERMS, SIGN_WIDTH
from lipcore.robots.urdf import PARAMETERS, RigidBody
from service.contract.datasets import JointExcitation, Verdict, Weight, WholeExcitation
from service.datasets.report.fit import FIT, OWN_FEATURES, Fit, friction_terms, own_features
from service.datasets.report.signals import Limits, Rows, spread


@dataclass(frozen=True)
class FrictionOptions:
    """When a recording determines a joint's friction."""

    max_shares: tuple[tuple[float, Verdict], ...] = ((0.02, "well"), (0.1, "poorly"))
    """Max share of the torque's spread that a weight's standard deviation stands for, by verdict."""
    negative_stds: float = 2.0
    """Min standard deviations below zero of negative friction."""
    negative_share: float = 0.03
    """Min share of the torque's spread of negative friction."""
    slow: float = 0.1
    """Speed in rad/s or m/s below which motion is slow: Coulomb friction and stiction show there."""
    seldom: float = 0.005
    """Share of samples below which a direction, or slow motion, counts as absent."""
    prior: float = 3.0
    """Standard deviation of gravity and inertia, over the root mean square of a joint's torque."""


FRICTION = FrictionOptions()


def joint_excitation(
    joint: int, name: str, columns: dict[str, Array], part: Rows, fit: Fit, noise: float, limits: Limits | None
) -> JointExcitation:
    """Judge one joint's motion, columns by quantity (M,) and the part of each row.

    fit: of all joints; noise: std of what it leaves of the joint's torque, N·m.
    """
    q, dq, ddq, tau = (columns[quantity] for quantity in ("q", "dq", "ddq", "tau"))
    stds = friction_stds(fit, joint, noise, float(np.sqrt(np.mean(tau**2))))
    worst, term = collinearity(q[fit.rows], dq[fit.rows], ddq[fit.rows])
    slow = np.abs(dq) < FRICTION.slow
    forwards, backwards = float(np.mean(dq > SIGN_WIDTH)), float(np.mean(dq < -SIGN_WIDTH))
    speed = float(np.sqrt(np.mean(dq**2)))
    return JointExcitation(
        joint=name,
        span=float(np.ptp(q)),
        visited=None if limits is None else _visited(q, float(limits.lower[joint]), float(limits.upper[joint])),
        speed_std=spread(dq),
        acceleration_std=spread(ddq),
        forwards=forwards,
        backwards=backwards,
        still=1.0 - forwards - backwards,
        reversals=reversals(dq, part),
        slow_forwards=float(np.mean(slow & (dq > SIGN_WIDTH))),
        slow_backwards=float(np.mean(slow & (dq < -SIGN_WIDTH))),
        **weights([(None, std) for std in stds], speed, spread(tau), min(forwards, backwards) < FRICTION.seldom),
        collinear=worst,
        collinear_term=term,
    )


Estimate = tuple[float | None, float | None]
"""A weight and its standard deviation, None where the data say nothing of it."""


def weights(friction: Sequence[Estimate], speed: float, torque: float, one_way: bool) -> dict[str, Weight]:
    """Judge a joint's viscous, Coulomb and offset weights.

    speed: root mean square; torque: standard deviation of the joint's; one_way: whether one direction is
    absent, so that nothing but standstill would tell Coulomb friction from an offset, which it does not.
    """
    sizes = (float(speed), 1.0, 1.0)
    out = {
        kind: _weight(*each, size, float(torque), kind != "offset")
        for kind, each, size in zip(FRICTION_TERMS, friction, sizes, strict=True)
    }
    if one_way:
        for kind in ("coulomb", "offset"):
            out[kind] = out[kind].model_copy(update={"verdict": "not determined", "implausible": False})
    return out


def friction_stds(fit: Fit, joint: int, noise: float, torque: float) -> tuple[float | None, float | None, float]:
    """Standard deviations of viscous, Coulomb and offset weights, None where the data say nothing of one.

    The weights themselves, beside terms that may be any function of motion, are not worth much: on simulated arms some
    were many standard deviations off. torque: root mean square of the joint's, N·m; nothing else that is fitted may be
    more than FRICTION.prior times it.
    """
    variance = noise**2 * len(fit.rows) / fit.independent
    known = np.isfinite(fit.scales)
    prior = np.full(len(fit.scales), FRICTION.prior * torque)
    # cos q, sin q: their raw weights are torques
    waves = np.flatnonzero([name in ("cos q", "sin q") for name in OWN_FEATURES] * (len(prior) // len(OWN_FEATURES)))
    prior[waves] *= np.where(known[waves], fit.scales[waves], 1.0)
    information = variance / np.maximum(prior, 1e-150) ** 2
    own = friction_terms(joint)
    information[list(own)] = 0.0
    # (C⁻¹ + D)⁻¹ without the inverse of C, which may be all but singular
    root = np.sqrt(information)
    inner = np.eye(len(root)) + root[:, None] * fit.covariance * root
    pulled = fit.covariance * root
    covariance = variance * (fit.covariance - pulled @ np.linalg.solve(inner, pulled.T))
    viscous, coulomb = (
        float(np.sqrt(max(0.0, covariance[term, term])) / fit.scales[term]) if known[term] else None for term in own
    )
    centre = np.where(known, fit.means / fit.scales, 0.0)
    offset = variance / len(fit.rows) + max(0.0, float(centre @ covariance @ centre))
    return viscous, coulomb, float(np.sqrt(offset))


def reversals(dq: Array, part: Rows) -> int:
    """How often a velocity (M,) changes its sign within a part, by more than SIGN_WIDTH to either side."""
    moving = np.flatnonzero(np.abs(dq) > SIGN_WIDTH)
    forwards, home = dq[moving] > 0, part[moving]
    return int(np.sum((forwards[1:] != forwards[:-1]) & (home[1:] == home[:-1])))


def collinearity(q: Array, dq: Array, ddq: Array) -> tuple[float, str]:
    """Largest share of one of OWN_FEATURES that the other four explain, and which one; 1 where one does not vary."""
    raw = np.column_stack(own_features(q, dq, ddq))
    centred = raw - raw.mean(axis=0)
    scale = centred.std(axis=0)
    still = scale <= FIT.min_spread * (1 + np.abs(raw).max(axis=0))
    if still.any():
        return 1.0, OWN_FEATURES[int(still.argmax())]
    correlation = np.corrcoef(centred, rowvar=False)
    inflation = np.diag(np.linalg.pinv(correlation, hermitian=True, rcond=1e-12))
    shares = np.clip(1 - 1 / np.maximum(inflation, 1.0), 0.0, 1.0)
    if np.linalg.eigvalsh(correlation)[0] < 1e-12:
        return 1.0, OWN_FEATURES[int(np.abs(np.linalg.eigh(correlation)[1][:, 0]).argmax())]
    return float(shares.max()), OWN_FEATURES[int(shares.argmax())]


def _visited(q: Array, lower: float, upper: float) -> float | None:
    if not np.isfinite(upper - lower):
        return None
    bins = 20  # of a joint's range
    visited = np.clip(((q - lower) * (bins / (upper - lower))).astype(np.int64), 0, bins - 1)
    return float(np.count_nonzero(np.bincount(visited, minlength=bins))) / bins


def _weight(value: float | None, std: float | None, factor: float, torque: float, friction: bool) -> Weight:
    if std is None or torque == 0:
        return Weight(value=value, std=std, share=None, verdict="not determined")
    share = std * factor / torque
    verdict = next((v for most, v in FRICTION.max_shares if share <= most), "not determined")
    negative = friction and verdict == "well" and value is not None and value < -FRICTION.negative_stds * std
    negative = negative and -(value or 0.0) * factor > FRICTION.negative_share * torque
    return Weight(value=value, std=std, share=share, verdict=verdict, implausible=negative)


@dataclass(frozen=True)
class ReferenceOptions:
    """Random motion that a recording's excitation of rigid bodies is compared with."""

    max_equations: int = 14_000
    """Max rows times joints of the recording: 2000 rows of 7 joints."""
    chunk: int = 1000
    """Equations in memory at a time."""
    equations: int = 3500
    """Rows times joints of random motion."""
    min_effect: float = 1e-8
    """Relative size below which a combination of parameters has no effect on torques."""
    resolution: float = 1e-13
    """Smallest relative information about a weight that differs from none."""
    excited: float = 0.01
    """Share of random motion's excitation above which a base parameter counts as excited."""
    speed: float = 1.0
    """Speed in rad/s or m/s where no limit is known."""
    turn_s: float = 0.5
    """Time in s in which the speed reverses."""


REFERENCE = ReferenceOptions()


@dataclass(frozen=True)
class RigidExcitation:
    """What the URDF tells of a recording. friction: each joint's weights in the order FRICTION_TERMS."""

    whole: WholeExcitation
    friction: list[list[Estimate]]


@dataclass(frozen=True)
class _Reference:
    """Random motion. regressor: (E, 10 n); base: columns that span it, (b,); back: (10 n, b) from coordinates in which
    it excites everything by 1.
    """

    regressor: Array
    base: NDArray[np.intp]
    back: Array


def judge_rigid_bodies(
    urdf: str,
    name: str,
    names: tuple[str, ...],
    limits: Limits,
    motion: tuple[Array, Array, Array],
    tau: Array,
    noise: Array,
    independent: float,
    gravity: bool,
) -> RigidExcitation | str:
    """Judge rows of motion q, dq, ddq and torque, (R, n) each; a sentence says why the URDF cannot be used for them.

    noise: std of what is left of each joint's torque, (n,) N·m; independent: samples that the rows stand for; gravity:
    whether torques contain it.
    """
    if limits.urdf_joints is None:
        return f"not all joints are those of robot {name}: its rigid bodies were not used"
    try:
        robot = RigidBody.from_urdf(urdf, names, limits.joint_types, limits.urdf_joints, name)
        kernel = ArmKernel(arm_of_robot(robot, gravity, "zero"))
    except (MissingExtraError, ValueError) as error:
        return f"the rigid bodies of robot {name} were not used: {error}"
    n, size = len(names), len(names) * PARAMETERS
    reference = _reference(kernel, limits)
    rows = np.linspace(0, len(motion[0]) - 1, min(len(motion[0]), REFERENCE.max_equations // n)).astype(np.int64)
    q, dq, ddq, tau = (each[rows] for each in (*motion, tau))
    gram, projected = np.zeros((size, size)), np.zeros(size + len(FRICTION_TERMS) * n)
    information = np.zeros((len(projected), len(projected)))
    loudness = np.maximum(noise, 1e-9 * max(float(noise.max()), 1e-9))
    for first, block in _regressors(kernel, q, dq, ddq):
        gram += block.T @ block
        some = dq[first : first + len(block) // n]
        both = np.hstack([block, _friction(some)]) / np.tile(loudness, len(some))[:, None]
        information += both.T @ both
        projected += both.T @ (tau[first : first + len(some)] / loudness).reshape(-1)
    excited, modes = np.linalg.eigh(reference.back.T @ gram @ reference.back / (n * len(q)))
    shares = np.sqrt(np.maximum(excited, 0.0))
    # whose parameters the least excited mode moves, weighed by the torque that random motion makes of them
    weakest = (reference.regressor * (reference.back @ modes[:, 0])).reshape(-1, n, PARAMETERS).sum(axis=2)
    whole = WholeExcitation(
        parameters=len(reference.base),
        rank=int(np.sum(shares > REFERENCE.excited)),
        condition=_condition(gram[np.ix_(reference.base, reference.base)]),
        weakest=float(shares[0]),
        weakest_body=names[int(np.square(weakest).sum(axis=0).argmax())],
    )
    each_row = independent / len(q)
    return RigidExcitation(whole, _friction_weights(information * each_row, projected * each_row, reference.back))


def _reference(kernel: ArmKernel, limits: Limits) -> _Reference:
    motion = _random_motion(limits, max(1, REFERENCE.equations // kernel.n_joints))
    regressor = np.concatenate([block for _, block in _regressors(kernel, *motion)])
    size = np.linalg.norm(regressor, axis=0)
    scale = np.where(size > 0, size, 1.0)
    _, values, directions = np.linalg.svd(regressor / scale, full_matrices=False)
    count = int(np.sum(values > REFERENCE.min_effect * values[0]))
    back = directions[:count].T / values[:count] * np.sqrt(len(regressor)) / scale[:, None]
    from scipy.linalg import qr  # noqa: PLC0415 - serving does without it

    base = np.sort(qr(regressor / scale, mode="r", pivoting=True)[1][:count])
    return _Reference(regressor, base, back)


def _friction(dq: Array) -> Array:
    """Friction's features as equations, row by row and joint by joint: (R n, 3 n)."""
    rows, n = dq.shape
    out = np.zeros((rows, n, n, len(FRICTION_TERMS)))
    joints = np.arange(n)
    out[:, joints, joints] = np.stack([dq, np.tanh(dq / SIGN_WIDTH), np.ones_like(dq)], axis=2)
    return out.reshape(rows * n, len(FRICTION_TERMS) * n)


def _friction_weights(information: Array, projected: Array, back: Array) -> list[list[Estimate]]:
    """The friction's weights beside unknown inertial parameters; information: (13 n, 13 n); projected: (13 n,)."""
    size, count = back.shape
    turn = np.zeros((len(information), count + len(information) - size))
    turn[:size, :count], turn[size:, count:] = back, np.eye(len(information) - size)
    base = turn.T @ information @ turn
    scale = np.sqrt(np.maximum(np.diag(base), 1e-300))
    values, vectors = np.linalg.eigh(base / np.outer(scale, scale))
    inverse = (vectors / np.maximum(values, REFERENCE.resolution)) @ vectors.T
    std = (np.sqrt(np.diag(inverse)) / scale)[count:].tolist()
    mean = (inverse @ (turn.T @ projected / scale) / scale)[count:].tolist()
    estimates: list[Estimate] = list(zip(mean, std, strict=True))
    return [estimates[first : first + len(FRICTION_TERMS)] for first in range(0, len(estimates), len(FRICTION_TERMS))]


def _condition(gram: Array) -> float | None:
    """Condition of a matrix with columns of equal norm, from its Gram matrix; None beyond what that can tell."""
    norm = np.sqrt(np.diag(gram))
    if (norm == 0).any():
        return None
    values = np.linalg.eigvalsh(gram / np.outer(norm, norm))
    return float(np.sqrt(values[-1] / values[0])) if values[0] > 1e-14 * values[-1] else None


def _regressors(kernel: ArmKernel, q: Array, dq: Array, ddq: Array) -> Iterator[tuple[int, Array]]:
    """The joint-torque regressor in blocks of equations, (E, 10 n) each, with the first row of motion of each."""
    rows = max(1, REFERENCE.chunk // q.shape[1])
    for first in range(0, len(q), rows):
        part = slice(first, first + rows)
        features = kernel.features(Motion.from_arrays(q[part], dq[part], ddq[part]))
        masses = features[:, :, : PARAMETERS * q.shape[1]]
        yield first, masses.reshape(-1, masses.shape[2])


def _random_motion(limits: Limits, rows: int) -> tuple[Array, Array, Array]:
    """Positions over the whole range, speeds up to the limits and accelerations that reverse them soon, (rows, n)."""
    rng = np.random.default_rng(7)
    lower = np.where(np.isnan(limits.lower), -np.pi, limits.lower)
    upper = np.where(np.isnan(limits.upper), np.pi, limits.upper)
    speed = np.where(np.isnan(limits.speed), REFERENCE.speed, limits.speed)
    shape = (rows, len(speed))
    return (
        rng.uniform(lower, upper, shape),
        rng.uniform(-speed, speed, shape),
        rng.uniform(-1, 1, shape) * speed / REFERENCE.turn_s,
    )
