"""Motion of a recording, and how well it determines friction and a robot's inertial parameters.

The standard deviation of a friction coefficient is that of least squares, with the noise level of the fit's residual
and the effective samples of the recording, two per period of the low-pass. The verdict depends on the torque of this
deviation (viscous: at the root-mean-square speed) as a share of the torque's standard deviation, see
`FrictionOptions`.

For rigid bodies, the regressor of the robot's URDF at a subset of rows is compared with that of random motion over the
whole range. In coordinates in which random motion excites every base parameter by 1, the least excited one limits the
identification.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lipcore.data.motion import Motion, spaced_rows
from lipcore.data.samples import Array
from lipcore.extras import MissingExtraError
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.arm_prior import arm_of_robot
from lipcore.kernels.drive.terms import BASE_TERMS, SIGN_WIDTH
from lipcore.robots.urdf import PARAMETERS, RigidBody
from service.contract.datasets import JointExcitation, Verdict, Weight, WholeExcitation
from service.datasets.report import texts
from service.datasets.report.fit import FIT, OWN_FEATURES, Fit, friction_terms, own_features
from service.datasets.report.signals import Limits, Rows, spread


@dataclass(frozen=True)
class FrictionOptions:
    """Thresholds of determined friction."""

    max_shares: tuple[tuple[float, Verdict], ...] = ((0.02, "well"), (0.1, "poorly"))
    """Max torque of a coefficient's standard deviation, as a share of the torque's spread, by verdict."""
    negative_stds: float = 2.0
    """Standard deviations below 0 at which friction is negative."""
    negative_share: float = 0.03
    """Share of the torque's spread above which friction is negative."""
    slow: float = 0.1
    """Speed in rad/s or m/s below which motion is slow and shows Coulomb friction and stiction."""
    seldom: float = 0.005
    """Share of samples below which a direction, or slow motion, counts as absent."""
    prior: float = 3.0
    """Standard deviation of gravity and inertia, over the root mean square of a joint's torque."""


FRICTION = FrictionOptions()


def joint_excitation(
    joint: int, name: str, columns: dict[str, Array], part: Rows, fit: Fit, noise: float, limits: Limits | None
) -> JointExcitation:
    """Judge one joint's motion by its columns by quantity, (M,), and the part of each row.

    fit: of all joints; noise: standard deviation of the fit's residual, N·m.
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
        reversals=count_reversals(dq, part),
        slow_forwards=float(np.mean(slow & (dq > SIGN_WIDTH))),
        slow_backwards=float(np.mean(slow & (dq < -SIGN_WIDTH))),
        **judge_friction([(None, std) for std in stds], speed, spread(tau), forwards, backwards),
        collinear=worst,
        collinear_term=term,
    )


Estimate = tuple[float | None, float | None]
"""A coefficient and its standard deviation, None if the data do not determine it."""


def judge_friction(
    friction: Sequence[Estimate], speed: float, torque: float, forwards: float, backwards: float
) -> dict[str, Weight]:
    """Judge a joint's viscous friction, Coulomb friction and offset.

    speed: root mean square; torque: standard deviation; forwards, backwards: shares of the samples that move. If one
    direction is absent, Coulomb friction cannot be separated from an offset; without motion, no friction is determined.
    """
    sizes = (float(speed), 1.0, 1.0)
    out = {
        kind: _weight(*each, size, float(torque), kind != "offset")
        for kind, each, size in zip(BASE_TERMS, friction, sizes, strict=True)
    }
    if min(forwards, backwards) < FRICTION.seldom:
        still = max(forwards, backwards) < FRICTION.seldom
        for kind in ("viscous", "coulomb", "offset") if still else ("coulomb", "offset"):
            unknown = {"value": None, "std": None, "share": None} if still else {}
            out[kind] = out[kind].model_copy(update={"verdict": "not determined", "implausible": False} | unknown)
    return out


def friction_stds(fit: Fit, joint: int, noise: float, torque: float) -> tuple[float | None, float | None, float]:
    """Return standard deviations of viscous friction, Coulomb friction and offset, None if undetermined.

    The estimates themselves are not reliable beside terms that may be any function of motion: on simulated arms, some
    were wrong by many standard deviations.

    torque: root mean square of the joint's torque, N·m; FRICTION.prior times it limits the other fitted terms.
    """
    variance = noise**2 * len(fit.rows) / fit.independent
    known = np.isfinite(fit.scales)
    prior = np.full(len(fit.scales), FRICTION.prior * torque)
    # unscaled weights of cos q and sin q are torques
    waves = np.flatnonzero([name in ("cos q", "sin q") for name in OWN_FEATURES] * (len(prior) // len(OWN_FEATURES)))
    prior[waves] *= np.where(known[waves], fit.scales[waves], 1.0)
    information = variance / np.maximum(prior, 1e-150) ** 2
    own = friction_terms(joint)
    information[list(own)] = 0.0
    # (C⁻¹ + D)⁻¹ without the inverse of C, which may be nearly singular
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


def count_reversals(dq: Array, part: Rows) -> int:
    """Count sign changes of a velocity (M,) within parts, ignoring magnitudes up to SIGN_WIDTH."""
    moving = np.flatnonzero(np.abs(dq) > SIGN_WIDTH)
    forwards, home = dq[moving] > 0, part[moving]
    return int(np.sum((forwards[1:] != forwards[:-1]) & (home[1:] == home[:-1])))


def collinearity(q: Array, dq: Array, ddq: Array) -> tuple[float, str]:
    """Return the largest share of one of OWN_FEATURES that the others explain, and its name; 1 if one is constant."""
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
    verdict = next((v for max_share, v in FRICTION.max_shares if share <= max_share), "not determined")
    negative = friction and verdict == "well" and value is not None and value < -FRICTION.negative_stds * std
    negative = negative and -(value or 0.0) * factor > FRICTION.negative_share * torque
    return Weight(value=value, std=std, share=share, verdict=verdict, implausible=negative)


@dataclass(frozen=True)
class ReferenceOptions:
    """Random motion with which a recording's excitation of rigid bodies is compared."""

    max_equations: int = 14_000
    """Max rows times joints of the recording: 2000 rows of 7 joints."""
    chunk: int = 1000
    """Equations in memory at a time."""
    equations: int = 3500
    """Rows times joints of random motion."""
    min_effect: float = 1e-8
    """Relative size below which a combination of parameters has no effect on torque."""
    resolution: float = 1e-13
    """Min relative information about a coefficient; less counts as none."""
    excited: float = 0.01
    """Share of random motion's excitation above which a base parameter counts as excited."""
    speed: float = 1.0
    """Speed in rad/s or m/s if no limit is known."""
    turn_s: float = 0.5
    """Time in s in which the speed reverses."""


REFERENCE = ReferenceOptions()


@dataclass(frozen=True)
class RigidExcitation:
    """Excitation of rigid bodies. friction: each joint's coefficients in the order BASE_TERMS."""

    whole: WholeExcitation
    friction: list[list[Estimate]]


@dataclass(frozen=True)
class _Reference:
    """Random motion.

    regressor: (E, 10 n); base: columns that span it, (b,); back: (10 n, b), from coordinates in which random motion
    excites everything by 1.
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
    """Judge rows of motion q, dq, ddq and torque, (R, n) each, or return why the URDF cannot be used.

    noise: standard deviation of each joint's residual, (n,) N·m; independent: effective samples of the recording;
    gravity: whether torques contain it.
    """
    if limits.urdf_joints is None:
        return texts.bodies_incomplete(name)
    try:
        robot = RigidBody.from_urdf(urdf, names, limits.joint_types, limits.urdf_joints, name)
        kernel = ArmKernel(arm_of_robot(robot, gravity, "zero"))
    except (MissingExtraError, ValueError) as error:
        return texts.bodies_unusable(name, error)
    n, size = len(names), len(names) * PARAMETERS
    reference = _reference(kernel, limits)
    rows = spaced_rows(len(motion[0]), REFERENCE.max_equations // n)
    q, dq, ddq, tau = (each[rows] for each in (*motion, tau))
    gram, projected = np.zeros((size, size)), np.zeros(size + len(BASE_TERMS) * n)
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
    # share of each body in the least excited mode, weighted by its torque under random motion
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
    """Return friction's features as equations, by row and then by joint: (R n, 3 n)."""
    rows, n = dq.shape
    out = np.zeros((rows, n, n, len(BASE_TERMS)))
    joints = np.arange(n)
    out[:, joints, joints] = np.stack([dq, np.tanh(dq / SIGN_WIDTH), np.ones_like(dq)], axis=2)
    return out.reshape(rows * n, len(BASE_TERMS) * n)


def _friction_weights(information: Array, projected: Array, back: Array) -> list[list[Estimate]]:
    """Estimate friction beside unknown inertial parameters; information: (13 n, 13 n); projected: (13 n,)."""
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
    return [estimates[first : first + len(BASE_TERMS)] for first in range(0, len(estimates), len(BASE_TERMS))]


def _condition(gram: Array) -> float | None:
    """Return the condition number of a matrix, columns scaled to equal norm, by its Gram matrix; None if too large."""
    norm = np.sqrt(np.diag(gram))
    if (norm == 0).any():
        return None
    values = np.linalg.eigvalsh(gram / np.outer(norm, norm))
    return float(np.sqrt(values[-1] / values[0])) if values[0] > 1e-14 * values[-1] else None


def _regressors(kernel: ArmKernel, q: Array, dq: Array, ddq: Array) -> Iterator[tuple[int, Array]]:
    """Yield the joint-torque regressor in blocks of equations, (E, 10 n), with the first row of motion of each."""
    rows = max(1, REFERENCE.chunk // q.shape[1])
    for first in range(0, len(q), rows):
        part = slice(first, first + rows)
        features = kernel.features(Motion.from_arrays(q[part], dq[part], ddq[part]))
        masses = features[:, :, : PARAMETERS * q.shape[1]]
        yield first, masses.reshape(-1, masses.shape[2])


def _random_motion(limits: Limits, rows: int) -> tuple[Array, Array, Array]:
    """Return positions over the whole range, speeds up to the limits and matching accelerations, (rows, n)."""
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
