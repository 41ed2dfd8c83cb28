"""Model how the errors of an arm's rows correlate: independent in every row, or similar in similar motion."""

from __future__ import annotations

import numpy as np

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.model.payload import Carrier
from lipcore.online.batch import Rows
from lipcore.posterior.linalg import solve_lower

LIKE = 0.3, 0.3
"""See `likeness`. Chosen among three pairs on the dirty Panda of seed 50."""


def noise_parts(carrier: Carrier, motion: Motion) -> tuple[Array, Array, Array]:
    """Return the variance of the torques at N instants in three parts, (N·m)².

    The parts are independent noise of every row, (n,); lasting errors, also of faster motion and of a local correction,
    (N, n); and errors of joints at rest, (N, n), which may break away at any time.
    """
    posterior = carrier.model.posterior
    noise, misfit = posterior.noise_variance, posterior.row_misfit
    white = np.maximum(noise - misfit.lasting, 1e-3 * noise)
    rest = misfit.at_rest(motion)
    lasting = misfit.lasting + posterior.misfit.variance(motion) - rest
    residual = posterior.basis.residual
    return white, lasting if residual is None else lasting + residual.beyond(motion), rest


def likeness(carrier: Carrier, q: Array, dq: Array, speed: float, pose: float) -> Array:
    """Return the correlation of the lasting errors of N instants, joint by joint: (n, N, N).

    These errors, such as friction, are functions of motion and not of time: similar if a joint moves similarly in a
    similar pose, whether just before or long ago. q, dq: (N, n). speed, pose: scales of the correlation, in the joint's
    velocity over its usual one, and in the root mean square over joints of the pose, rad (m).
    """
    faster = np.abs(dq[:, None] - dq[None]) / carrier.model.posterior.misfit.speed
    apart = np.sqrt(((q[:, None] - q[None]) ** 2).mean(axis=-1, keepdims=True))
    return np.asarray(np.exp(-faster / speed - apart / pose).transpose(2, 0, 1))


def correlation_roots(carrier: Carrier, rows: Rows) -> Array:
    """Return the Cholesky roots of the covariance of the errors of N rows, joint by joint: (n, N, N) N·m."""
    white, lasting, rest = noise_parts(carrier, rows.motion())
    deviation = np.sqrt((lasting + rest).T)
    covariance = deviation[:, :, None] * deviation[:, None, :] * likeness(carrier, rows.q, rows.dq, *LIKE)
    covariance[:, np.arange(len(rows)), np.arange(len(rows))] += white[:, None]
    return np.asarray(np.linalg.cholesky(covariance))


def excess_variance(roots: Array, whitened: Array, count: int) -> Array:
    """Return by how much the last `count` rows exceed the variance of their errors, (n,) (N·m)².

    whitened: (N n,) residuals, joint by joint.
    """
    residual = (roots @ whitened.reshape(len(roots), -1, 1))[..., 0]
    return np.asarray((residual**2 - (roots**2).sum(axis=-1))[:, -count:].mean(axis=1).clip(0.0))


def whiten(roots: Array, features: Array, residual: Array) -> tuple[Array, Array]:
    """Return features (M + 10, N n) and residuals (N n,) with independent errors of variance one."""
    both = np.concatenate([features, residual[None]]).transpose(2, 1, 0)
    solved = np.stack([solve_lower(root, np.ascontiguousarray(each)) for root, each in zip(roots, both, strict=True)])
    flat = solved.reshape(-1, both.shape[2]).T
    return flat[:-1], flat[-1]
