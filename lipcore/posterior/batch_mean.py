"""Mean torques of large batches, without the features that a standard deviation needs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lipcore.data.motion import Array, Motion
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.drive.kernel import DriveKernel
from lipcore.kernels.fast.arm_recursion import PARAMETERS
from lipcore.kernels.graph import Graph, Number, Program
from lipcore.kernels.joint_frames import links_of, torque
from lipcore.kernels.residual import ResidualKernel, residual_inputs
from lipcore.kernels.tape import Tape
from lipcore.posterior.compact import CompactPosterior

ROWS = 256
"""States whose correlations with all centres are computed together: they stay in the cache."""


class BatchMean:
    """Posterior mean of the torques of rigid bodies, drive and local correction at N states.

    The bodies' torque is one program of single operations (`kernels.joint_frames`), made for these weights in tens of
    milliseconds; the drive is linear in its terms, the correction in its centres' correlations. It is thread-safe.
    """

    def __init__(self, posterior: CompactPosterior) -> None:
        residual, (arm, drive) = posterior.basis.residual, posterior.basis.linear[-2:]
        assert isinstance(arm, ArmKernel)
        assert isinstance(drive, DriveKernel)
        self._order, self._drive = arm.arm.order, drive.drive
        weights, n = posterior.slopes[posterior.basis.rows(arm)], arm.n_joints
        bodies, rotor, rest = np.split(weights, [PARAMETERS * n, arm.steps.start])
        step, mixed = rest[: arm.arm.steps], rest[arm.arm.steps :]
        friction = posterior.slopes[posterior.basis.rows(drive)].reshape(n, -1)
        self._own = np.concatenate([rotor[:, None], friction], axis=1).T
        change = bodies.reshape(n, PARAMETERS)[self._order] - arm.arm.parameters
        graph = Graph()
        q, dq, ddq, *turn = (graph.inputs(n) for _ in range(5))
        links = links_of(arm.arm.geometry, step, arm.arm.parameters, change)
        first = torque(links, q, dq, ddq, turn)
        torques: list[Number] = [each.value + each.change for each in first]
        loads = [each.value for each in first] if self._drive.needs_bodies else []
        if arm.others is not None:
            shares = arm.others.mixing @ mixed
            for share, other in zip([-shares.sum(), *shares], arm.arm.alternatives, strict=True):
                none = np.zeros_like(other.parameters)
                geometry = replace(other.geometry, gravity=arm.arm.alternatives[0].geometry.gravity)
                links = links_of(geometry, np.zeros(0), other.parameters, none)
                alone = torque(links, q, dq, ddq, turn)
                torques = [one + each.value * share for one, each in zip(torques, alone, strict=True)]
                self._own += share * np.concatenate([other.rotor[:, None], other.friction], axis=1).T
        learnt = np.zeros(0) if residual is None else posterior.slopes[posterior.basis.rows(residual)]
        self._near = [] if residual is None else _nearest(residual, learnt)
        self._tape = Tape.of(Program.of([*torques, *loads]))

    @staticmethod
    def applies_to(posterior: CompactPosterior) -> bool:
        """Return whether these are all the terms of a posterior."""
        kinds = [type(each) for each in posterior.basis.linear if each is not posterior.basis.residual]
        return kinds == [ArmKernel, DriveKernel] and not len(posterior.basis.outputs)

    def __call__(self, motion: Motion) -> Array:
        """Return the means, (N, n) N·m."""
        q, dq, ddq = (np.ascontiguousarray(each.T[self._order]) for each in (motion.q, motion.dq, motion.ddq))
        found = self._tape(np.concatenate([q, dq, ddq, np.sin(q), np.cos(q)]))
        chains = np.empty((len(found) // len(q), len(motion), len(q)))
        chains[:, :, self._order] = found.reshape(len(chains), len(q), -1).swapaxes(1, 2)
        terms = self._drive.formula(motion, chains[1] if len(chains) > 1 else None)
        total = chains[0] + self._own[0] * motion.ddq
        for weights, term in zip(self._own[1:], terms, strict=True):
            total += weights * term
        for first in range(0, len(motion) if self._near else 0, ROWS):
            inputs = residual_inputs(motion[first : first + ROWS])
            for near in self._near:
                total[first : first + ROWS, near.joint] += near.torque(inputs)
        return np.asarray(total)


@dataclass(frozen=True)
class _Near:
    """The correction of a joint: Σ_c weights_c exp(−½ |x − z_c|²), with x and the centres z in lengthscales."""

    joint: int
    rates: Array
    """One over the lengthscales, (4 n,)."""
    centres: Array
    """zᵀ, (4 n, m)."""
    weights: Array
    """(m,) N·m."""
    sizes: Array
    """½ |z|², (m,)."""

    def torque(self, inputs: Array) -> Array:
        """Return the correction at N states, (N,) N·m. inputs: `residual_inputs`."""
        x = inputs * self.rates
        exponents = x @ self.centres
        exponents -= self.sizes
        exponents -= 0.5 * (x * x).sum(axis=1)[:, None]
        return np.asarray(np.exp(exponents, out=exponents) @ self.weights)


def _nearest(residual: ResidualKernel, slopes: Array) -> list[_Near]:
    """Return the corrections of the joints that have one. slopes: factors of the features, (p,)."""
    found = []
    for joint, each in enumerate(residual.joints):
        if len(each.centres):
            centres, weights = each.centres.astype(np.float64), each.weights.copy()
            weights[: len(each.root)] += slopes[residual.of_joint(joint)] @ each.root
            sizes = 0.5 * np.square(centres).sum(axis=1)
            found.append(_Near(joint, 1 / each.lengthscales, np.ascontiguousarray(centres.T), weights, sizes))
    return found
