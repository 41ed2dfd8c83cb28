"""How the errors of an arm's rows belong together: new in every row, or alike in motion that is alike."""

from __future__ import annotations

import numpy as np

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.model.payload import Carrier
from lipcore.online.batch import Rows
from lipcore.posterior.linalg import solve_lower

LIKE = 0.3, 0.3
"""See `likeness`. Chosen on the dirty Panda of seed 50 among three pairs."""


def noise_parts(carrier: Carrier, motion: Motion) -> tuple[Array, Array, Array]:
    """Variance of the torques at N instants, (N·m)²: what is new in every row, (n,); what is not, as errors that last
    are, and those of faster motion, (N, n); and that of joints at rest, (N, n), which may break away at any time."""
    posterior = carrier.model.posterior
    noise, misfit = posterior.noise_variance, posterior.misfit
    white = np.maximum(noise - misfit.lasting, 1e-3 * noise)
    rest = misfit.at_rest(motion.dq)
    return white, (misfit.lasting + misfit.variance(motion) - rest), rest


def likeness(carrier: Carrier, q: Array, dq: Array, speed: float, pose: float) -> Array:
    """Correlation of the errors of N instants that are not new in each, joint by joint: (n, N, N).

    They are functions of motion, as friction is, and not of time: alike where a joint moves alike in a pose that is
    alike, whether just before or long ago. q, dq: (N, n); speed, pose: differences over which they become others, of
    the joint's velocity in units of its usual one, and of the pose, root mean square over joints, rad (m).
    """
    faster = np.abs(dq[:, None] - dq[None]) / carrier.model.posterior.misfit.speed
    apart = np.sqrt(((q[:, None] - q[None]) ** 2).mean(axis=-1, keepdims=True))
    return np.asarray(np.exp(-faster / speed - apart / pose).transpose(2, 0, 1))


def correlation_roots(carrier: Carrier, rows: Rows) -> Array:
    """Cholesky roots of the covariance of the errors of N rows, joint by joint: (n, N, N) N·m."""
    white, lasting, rest = noise_parts(carrier, rows.motion())
    deviation = np.sqrt((lasting + rest).T)
    covariance = deviation[:, :, None] * deviation[:, None, :] * likeness(carrier, rows.q, rows.dq, *LIKE)
    covariance[:, np.arange(len(rows)), np.arange(len(rows))] += white[:, None]
    return np.asarray(np.linalg.cholesky(covariance))


def whitened(roots: Array, features: Array, residual: Array) -> tuple[Array, Array]:
    """Features (M + 10, N n) and residuals (N n,) whose errors are independent, of variance one."""
    both = np.concatenate([features, residual[None]]).transpose(2, 1, 0)
    solved = np.stack([solve_lower(root, np.ascontiguousarray(each)) for root, each in zip(roots, both, strict=True)])
    flat = solved.reshape(-1, both.shape[2]).T
    return flat[:-1], flat[-1]
