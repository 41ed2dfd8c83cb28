"""How one joint was moved, and how well that would tell the weights of its friction.

A weight's standard deviation is that of least squares with the noise that the fit leaves, over as many independent rows
as the recording has: two a period of the low-pass. It is judged by the torque it stands for (viscous: at the usual
speed) as a share of the spread of the joint's torque, see DETERMINED.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lipcore.data.samples import Array
from lipcore.kernels.friction import FRICTION_TERMS, SIGN_WIDTH
from service.datasets.report.fit import OWN, Fit, friction_terms, own_features
from service.datasets.report.signals import Limits
from service.datasets.report.timing import Rows, spread
from service.datasets.schema import JointExcitation, Verdict, Weight

DETERMINED: tuple[tuple[float, Verdict], ...] = ((0.02, "well"), (0.1, "poorly"))
"""Largest share of the torque's spread that a weight's standard deviation may stand for, by verdict."""
SLOW = 0.1
"""rad/s or m/s below which motion is slow: Coulomb friction and stiction show there."""
SELDOM = 0.005
"""Share of samples below which a direction, or slow motion, counts as absent."""
BINS = 20
STANDSTILL = 1e-9
PRIOR = 3.0
"""Times the root mean square of a joint's torque: what gravity or inertia may be at most, as a standard deviation."""
TERMS = ("dq", "sign dq", "ddq", "cos q", "sin q")


def joint_excitation(
    joint: int, name: str, columns: dict[str, Array], part: Rows, fit: Fit, noise: float, limits: Limits | None
) -> JointExcitation:
    """Judge one joint's motion, columns by quantity (M,) and the part of each row.

    fit: of all joints; noise: std of what it leaves of the joint's torque, N·m.
    """
    q, dq, ddq, tau = (columns[quantity] for quantity in ("q", "dq", "ddq", "tau"))
    stds = friction_stds(fit, joint, noise, float(np.sqrt(np.mean(tau**2))))
    worst, term = collinearity(q[fit.rows], dq[fit.rows], ddq[fit.rows])
    slow = np.abs(dq) < SLOW
    forwards, backwards = float(np.mean(dq > SIGN_WIDTH)), float(np.mean(dq < -SIGN_WIDTH))
    return JointExcitation(
        joint=name,
        span=float(np.ptp(q)),
        visited=None if limits is None else _visited(q, float(limits.lower[joint]), float(limits.upper[joint])),
        speed_std=spread(dq),
        acceleration_std=spread(ddq),
        forwards=forwards,
        backwards=backwards,
        reversals=reversals(dq, part),
        slow_forwards=float(np.mean(slow & (dq > SIGN_WIDTH))),
        slow_backwards=float(np.mean(slow & (dq < -SIGN_WIDTH))),
        **weights(stds, float(np.sqrt(np.mean(dq**2))), spread(tau), min(forwards, backwards) < SELDOM),
        collinear=worst,
        collinear_term=term,
    )


def weights(stds: Sequence[float | None], speed: float, torque: float, one_way: bool) -> dict[str, Weight]:
    """Judge the standard deviations of a joint's viscous, Coulomb and offset weights.

    speed: root mean square; torque: standard deviation of the joint's; one_way: whether one direction is
    absent, so that nothing but standstill would tell Coulomb friction from an offset, which it does not.
    """
    sizes = (float(speed), 1.0, 1.0)
    out = {kind: _weight(std, size, float(torque)) for kind, std, size in zip(FRICTION_TERMS, stds, sizes, strict=True)}
    if one_way:
        for kind in ("coulomb", "offset"):
            out[kind] = out[kind].model_copy(update={"verdict": "not determined"})
    return out


def friction_stds(fit: Fit, joint: int, noise: float, torque: float) -> tuple[float | None, float | None, float]:
    """Standard deviations of viscous, Coulomb and offset weights, None where the data say nothing of one.

    torque: root mean square of the joint's, N·m; nothing else that is fitted may be more than PRIOR of it.
    """
    variance = noise**2 * len(fit.rows) / fit.independent
    known = np.isfinite(fit.scales)
    prior = np.full(len(fit.scales), PRIOR * torque)
    waves = np.flatnonzero(np.arange(len(prior)) % OWN >= OWN - 2)  # cos q, sin q: their raw weights are torques
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
    """Largest share of one of TERMS that the other four explain, and which one; 1 where one does not vary."""
    raw = np.column_stack(own_features(q, dq, ddq))
    centred = raw - raw.mean(axis=0)
    scale = centred.std(axis=0)
    still = scale <= STANDSTILL * (1 + np.abs(raw).max(axis=0))
    if still.any():
        return 1.0, TERMS[int(still.argmax())]
    correlation = np.corrcoef(centred, rowvar=False)
    inflation = np.diag(np.linalg.pinv(correlation, hermitian=True, rcond=1e-12))
    shares = np.clip(1 - 1 / np.maximum(inflation, 1.0), 0.0, 1.0)
    if np.linalg.eigvalsh(correlation)[0] < 1e-12:
        return 1.0, TERMS[int(np.abs(np.linalg.eigh(correlation)[1][:, 0]).argmax())]
    return float(shares.max()), TERMS[int(shares.argmax())]


def _visited(q: Array, lower: float, upper: float) -> float | None:
    if not np.isfinite(upper - lower):
        return None
    bins = np.clip(((q - lower) * (BINS / (upper - lower))).astype(np.int64), 0, BINS - 1)
    return float(np.count_nonzero(np.bincount(bins, minlength=BINS))) / BINS


def _weight(std: float | None, factor: float, torque: float) -> Weight:
    if std is None or torque == 0:
        return Weight(std=std, share=None, verdict="not determined")
    share = std * factor / torque
    return Weight(std=std, share=share, verdict=next((v for most, v in DETERMINED if share <= most), "not determined"))
