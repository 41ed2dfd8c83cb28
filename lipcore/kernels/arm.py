"""The arm's kernel: torque that is linear in masses, rotor inertia and small changes of geometry."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.kernels.arm_prior import KINDS, Arm
from lipcore.kernels.arrays import constant, on_diagonal, reordered
from lipcore.kernels.base import LinearKernel, Params, Regressor, State
from lipcore.kernels.fast.arm import (
    arm_energies,
    arm_queries,
    arm_query,
    arm_size,
    arm_torques,
)
from lipcore.kernels.fast.arm_recursion import PARAMETERS
from lipcore.kernels.fast.views import Memory
from lipcore.kernels.geometry import Geometry
from lipcore.kernels.mixture import MixtureKernel
from lipcore.kernels.newton_euler import linearised_torque, rigid_body_features

SCALES = 4
"""Number of kinds of weights with their own scale: masses, first moments, inertias, rotors."""


class ArmKernel(LinearKernel):
    """tau = Y(θ) π + r ∘ ddq + J (δθ) + Σ c_k δ_k around an arm, J = ∂(Y π)/∂θ.

    Y π is `newton_euler.rigid_body_torque`. Compiled code computes its features, derivatives and energies; they equal
    the formula.

    The weights are, in this order:

    - π, ten parameters for each body, (10 n,), in the order of the data's joints;
    - the rotor inertias r, (n,), in the same order;
    - the steps of the geometry, (g,), base to tip;
    - the weights of the alternative arms δ_k, (K,), see `MixtureKernel`.

    Their standard deviations are those of the arm. Those of π and r are multiplied by `exp(rigid_body.log_scale)`,
    (4,), one scale for each kind.
    """

    def __init__(self, arm: Arm) -> None:
        self.arm, self.n_joints = arm, arm.n_joints
        kinds = np.concatenate([np.tile(KINDS, arm.n_joints), np.full(arm.n_joints, SCALES - 1)])
        self._kinds = kinds
        self._unit = arm.unit
        self.others = MixtureKernel(arm, arm.alternatives) if arm.alternatives else None
        mixed = None if self.others is None else self.others.prior_weights()
        others = np.zeros(0) if mixed is None else mixed
        self._rest = np.concatenate([arm.widths, np.ones(len(others))])
        self._mean = np.concatenate([_mean_in_data_order(arm), arm.rotor, arm.expected, others])
        self._recent: tuple[tuple[Motion, Array], ...] = ()

    @property
    def size(self) -> int:
        """Number of weights p."""
        return len(self._mean)

    @property
    def steps(self) -> slice:
        """Indices of the geometry's steps among the weights."""
        first = (PARAMETERS + 1) * self.n_joints
        return slice(first, first + self.arm.steps)

    def geometry(self, weights: Array) -> Geometry:
        """Return the arm's geometry after the steps in these weights, (p,)."""
        return self.arm.geometry.moved(weights[self.steps]) if self.arm.steps else self.arm.geometry

    def torque(self, weights: Array, motion: Motion) -> Array:
        """Return Y(θ + δθ) π + r ∘ ddq of these weights, (p,), not linearised: (N, n) N·m.

        Alternative arms are not included.
        """
        n, geometry = self.n_joints, self.geometry(weights)
        bodies = np.ascontiguousarray(weights[: PARAMETERS * n].reshape(n, PARAMETERS)[self.arm.order])
        out = np.zeros((len(motion), n))
        arm_torques(geometry.constants, geometry.gravity, bodies, self.arm.order, motion.arrays(), out)
        return np.asarray(out + weights[PARAMETERS * n : (PARAMETERS + 1) * n] * motion.ddq)

    def formula(self, x: Motion) -> Array:
        """Return Φᵀ of N queries, (p, n, N), see `LinearKernel.formula`."""
        arm, n = self.arm, self.n_joints
        masses, steps = rigid_body_features(arm.geometry, arm.parameters, State.paired(x).ordered(arm.order))
        masses = reordered(masses.reshape(n, PARAMETERS, n, -1), arm.place).reshape(PARAMETERS * n, n, -1)
        xp = array_namespace(masses)
        rows = [reordered(masses, arm.place, 1), on_diagonal(x.ddq.T)]
        if arm.steps:
            rows.append(reordered(steps, arm.place, 1))
        if self.others is not None:
            rows.append(self.others.formula(x))
        return xp.concat(rows)

    def weighted(self, weights: Array, x: Motion) -> Array:
        """Return Φ w of N queries, (n, N), without the features; see `LinearKernel.weighted`."""
        arm, n = self.arm, self.n_joints
        bodies, rotor, rest = np.split(weights, [PARAMETERS * n, self.steps.start])
        bodies, state = bodies.reshape(n, PARAMETERS)[arm.order], State.paired(x).ordered(arm.order)
        torque = linearised_torque(arm.geometry, bodies, state, arm.parameters, rest[: arm.steps])
        torque = reordered(torque, arm.place) + (constant(rotor, x.ddq) * x.ddq).T
        return torque if self.others is None else torque + self.others.weighted(rest[arm.steps :], x)

    def features(self, x: Motion) -> Array:
        """Return Φ at each sample, (N, n, p)."""
        for seen, features in self._recent:
            if all(getattr(seen, f.name) is getattr(x, f.name) for f in fields(x)):
                return features
        features = super().features(x)
        # the training samples and the current query are evaluated many times
        self._recent = ((x, features), *self._recent[:3])
        return features

    def regressor(self) -> Regressor:
        """Return the regressor that computes the same features for single queries."""
        return ArmRegressor(self)

    def of_joint(self, joint: int) -> NDArray[np.int64]:
        """Return the places of the weights that a joint's torque may depend on: of its arm, not of bodies before it."""
        n, place, own = self.n_joints, self.arm.place, self.arm.arm_of == self.arm.arm_of[joint]
        used = np.ones(self.size, dtype=bool)
        used[: PARAMETERS * n] = np.repeat((place >= place[joint]) & own, PARAMETERS)
        used[PARAMETERS * n : self.steps.start] = np.arange(n) == joint
        if self.arm.steps:
            used[self.steps] = np.repeat(own[self.arm.order], self.arm.geometry.screws)
        return np.flatnonzero(used)

    def variances(self, params: Params) -> Array:
        """Return the prior variances of the weights, (p,)."""
        scale = params["rigid_body.log_scale"]
        xp = array_namespace(scale)
        std = xp.asarray(self._unit) * xp.exp(scale[self._kinds])
        return xp.square(xp.concat([std, xp.asarray(self._rest)]))

    def variances_adjoint(self, params: Params, slopes: Array) -> dict[str, Array]:
        """Return the derivatives by the scales, given the derivatives by the variances, (p,)."""
        count = len(self._kinds)
        scaled = 2 * self.variances(params)[:count] * slopes[:count]
        return {"rigid_body.log_scale": np.bincount(self._kinds, scaled, SCALES).astype(np.float64)}

    def prior_weights(self) -> Array | None:
        """Return the prior mean of the weights, (p,)."""
        return self._mean

    def initial(self, motion: Motion, tau: Array) -> dict[str, Array]:
        """Start with the arm's own scales, (4,)."""
        return {"rigid_body.log_scale": np.zeros(SCALES)}

    def energy_features(self, x: Motion) -> Array:
        """Return the kinetic and the potential energy per unit weight, (N, 2, p) J; zero for alternative arms."""
        out, arm = np.empty((len(x), 2, self.steps.stop)), self.arm
        arm_energies(arm.geometry.constants, arm.geometry.gravity, arm.parameters, arm.order, x.arrays(), out)
        none = np.zeros((len(x), 2, self.size - self.steps.stop))
        return np.concatenate([out, none], axis=2)


class ArmRegressor(Regressor):
    """Features of `ArmKernel` for single queries."""

    def __init__(self, kernel: ArmKernel) -> None:
        arm = kernel.arm
        self.n_joints, self.size = arm.n_joints, kernel.size
        self._order, self._first = arm.order.astype(np.int64), kernel.steps.stop
        self._others = None if kernel.others is None else kernel.others.regressor()
        fixed = arm.geometry.constants, arm.geometry.gravity, arm.parameters
        self._memory = Memory(fixed, arm_size(arm.n_joints))

    def fill(self, motion: Array, out: Array) -> None:
        """Write Φᵀ of the query, (p, n)."""
        arm_query(self._memory.flat, self._order, motion, out[: self._first])
        if self._others is not None:
            self._others.fill(motion, out[self._first :])

    def fill_many(self, motions: Array, out: Array, first: int) -> None:
        """Write Φᵀ of N queries; see `Regressor.fill_many`."""
        arm_queries(self._memory.flat, self._order, motions, out, first, first + self._first)
        if self._others is not None:
            self._others.fill_many(motions, out, first + self._first)


def _mean_in_data_order(arm: Arm) -> Array:
    """Return the prior mean of π, flat, in the order of the data's joints."""
    return np.asarray(arm.centre[arm.place].reshape(-1))
