"""A model as one pure function of the array API: torque and its standard deviation at a batch of states.

NumPy, PyTorch and JAX compute it from the formulas of `lipcore/kernels`, so it can be compiled, differentiated and
mapped by them. It returns what the compiled code of a service returns, but it never falls back: if the training does
not determine a torque, the standard deviation is large.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from array_api_compat import array_namespace

from lipcore.data.motion import Array, Motion
from lipcore.kernels.arrays import constant, reordered
from lipcore.kernels.base import State
from lipcore.kernels.drive.play import element_widths
from lipcore.kernels.fast.answer import root_of_part
from lipcore.model.torque_model import TorqueModel
from lipcore.posterior.compact import CompactPosterior


def function(model: TorqueModel) -> TorqueFunction:
    """Return the function of a model, see `TorqueFunction`."""
    return TorqueFunction(model)


class TorqueFunction:
    """tau, tau_std = f(q, dq, ddq, drive_state): posterior mean and standard deviation of the torques, N·m (N).

    All arguments and results have the shape (n,), or (..., n) for a batch, and one library, type and device.
    `drive_state` is what `drive_step` returns, or None if the motion before is unknown. Without friction that remembers
    (`remembers`), it has no effect. In float32, torques deviate by about 1e-6 of the largest. Models of energies and
    other nonlinear terms need float64, and raise ValueError without it.

    Example: gradients of an effort by the accelerations, in JAX.

        f = lipcore.export.function.function(model)
        effort = lambda ddq: (f(q, dq, ddq)[0] ** 2).sum()
        jax.jit(jax.grad(effort))(ddq)
    """

    def __init__(self, model: TorqueModel) -> None:
        self.joint_names, self.remembers = model.joint_names, model.remembers
        self._posterior, self._n = model.posterior, model.n_joints
        self._widths = element_widths(model.joint_types)
        self._roots = _roots_of(model.posterior)

    def __call__(self, q: Array, dq: Array, ddq: Array, drive_state: Array | None = None) -> tuple[Array, Array]:
        """Return torques and standard deviations, of the shape of q."""
        motion = self._motion(q, dq, ddq, drive_state)
        cross, local = self._cross(motion), self._local(motion)
        tau = self._mean(motion, cross, local)
        std: Array = array_namespace(q).sqrt(self._variance(motion, cross, local))
        return tau.T.reshape(q.shape), std.reshape(q.shape)

    def torque(self, q: Array, dq: Array, ddq: Array, drive_state: Array | None = None) -> Array:
        """Return the torques alone, in a fraction of the time."""
        motion = self._motion(q, dq, ddq, drive_state)
        return self._mean(motion, self._cross(motion), self._local(motion)).T.reshape(q.shape)

    def drive_start(self, q: Array) -> Array:
        """Return the drive's state at positions q after unknown motion, (..., 1 + 2 K, n)."""
        xp, bounds = array_namespace(q), [-1.0] * len(self._widths) + [1.0] * len(self._widths)
        state: Array = xp.stack([q, *(xp.full_like(q, each) for each in bounds)], axis=-2)
        return state

    def drive_step(self, q: Array, drive_state: Array) -> Array:
        """Return the drive's state after a motion to q, (..., 1 + 2 K, n).

        q: (..., n). Use small steps: an element does not follow motion to and fro within one step.
        """
        xp, widths = array_namespace(q), constant(np.tile(self._widths, (2, 1)), q)
        step = (q - drive_state[..., 0, :])[..., None, :] / widths
        state: Array = xp.concat([q[..., None, :], xp.clip(drive_state[..., 1:, :] + step, -1.0, 1.0)], axis=-2)
        return state

    def _motion(self, q: Array, dq: Array, ddq: Array, drive_state: Array | None) -> Motion:
        if q.shape[-1] != self._n:
            raise ValueError(f"q has shape {tuple(q.shape)}, expected (..., {self._n}): {', '.join(self.joint_names)}")
        if len(self._posterior.basis.outputs) and q.dtype != array_namespace(q).float64:
            raise ValueError(f"q is {q.dtype}, expected float64: in this model, large numbers cancel")
        motion = Motion(*(each.reshape(-1, self._n) for each in (q, dq, ddq)))
        if drive_state is None:
            return motion
        elements = len(self._widths)
        state = drive_state.reshape(-1, 1 + 2 * elements, self._n)
        low, high = state[:, 1 : 1 + elements], state[:, 1 + elements :]
        return replace(motion, deflections=array_namespace(q).concat([(low + high) / 2, (high - low) / 2], axis=1))

    def _local(self, motion: Motion) -> tuple[Array, Array, Array] | None:
        """Return `ResidualKernel.formulas` of a correction, or None."""
        residual = self._posterior.basis.residual
        return None if residual is None else residual.formulas(motion)

    def _cross(self, motion: Motion) -> Array | None:
        """Return the covariances of the inducing torques with those of N queries, (m, n, N), or None without any."""
        basis, params, like = self._posterior.basis, self._posterior.params, motion.q
        if basis.term is None or not len(basis.outputs):
            return None
        xp = array_namespace(like)
        sample, joint = np.divmod(basis.outputs, self._n)
        used, place = np.unique(sample, return_inverse=True)
        anchors = State(*(constant(each[used].T[:, :, None], like) for each in _parts(basis.inducing)))
        queries = State(*(each.T[:, None] for each in _parts(motion)))
        blocks = basis.term.blocks({name: constant(value, like) for name, value in params.items()}, anchors, queries)
        rows = xp.permute_dims(blocks, (2, 0, 1, 3)).reshape(-1, *blocks.shape[1:2], blocks.shape[3])
        return reordered(rows, place * self._n + joint)

    def _mean(self, motion: Motion, cross: Array | None, local: tuple[Array, Array, Array] | None) -> Array:
        """Return the means of N torques, (n, N)."""
        basis, slopes, xp = self._posterior.basis, self._posterior.slopes, array_namespace(motion.q)
        parts = [] if cross is None else [(slopes[: len(cross)], cross)]
        total: Array = xp.zeros_like(motion.q.T)
        for each in basis.linear:
            own = slopes[basis.rows(each)]
            if local is not None and each is basis.residual:
                total = total + local[1]
                parts.append((own, local[0]))
            else:
                total = total + each.weighted(own, motion)
        for own, rows in parts:
            total = total + xp.tensordot(constant(own, rows), rows, axes=1)
        return total

    def _variance(self, motion: Motion, cross: Array | None, local: tuple[Array, Array, Array] | None) -> Array:
        """Return the variances of N torques, (N, n)."""
        posterior, basis, xp = self._posterior, self._posterior.basis, array_namespace(motion.q)
        features = [
            local[0] if local is not None and each is basis.residual else each.formula(motion) for each in basis.linear
        ]
        rows = xp.permute_dims(xp.concat(features if cross is None else [cross, *features]), (1, 0, 2))  # (n, M, N)
        learnt = xp.matmul(constant(self._roots, rows), rows)
        squares = learnt * learnt
        variance = squares.sum(1)
        if cross is not None:
            assert basis.term is not None
            own = State(*(each.T for each in _parts(motion)))
            params = {name: constant(value, rows) for name, value in posterior.params.items()}
            prior = [row[joint] for joint, row in enumerate(basis.term.blocks(params, own, own))]
            variance = xp.stack(prior) + variance - 2 * squares[:, : len(cross)].sum(1)
        variance = posterior.std_factor**2 * variance
        if local is not None:
            variance = variance + local[2]
        total: Array = xp.maximum(variance.T + posterior.misfit.variance(motion), constant(posterior.floor, rows))
        return total


def _roots_of(posterior: CompactPosterior) -> Array:
    """Return the root Q for each joint, its rows in the order of Q, (n or 1, K, M).

    Without inducing torques, it is that of the weights that a joint's torque depends on, and zero for others.
    """
    linear, roots = posterior.basis.linear, []
    if len(posterior.basis.outputs):
        return posterior.feature_root[None]
    for joint in range(linear[0].n_joints):
        places = np.concatenate([posterior.basis.rows(each).start + each.of_joint(joint) for each in linear])
        root = np.zeros((len(places), len(posterior.weights)))
        root[:, places] = root_of_part(posterior.feature_root, places)
        roots.append(root)
    most = max(map(len, roots))
    return np.stack([np.pad(each, ((0, most - len(each)), (0, 0))) for each in roots])


def _parts(motion: Motion) -> tuple[Array, Array, Array]:
    return motion.q, motion.dq, motion.ddq
