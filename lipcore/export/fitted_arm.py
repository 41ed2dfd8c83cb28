"""The arm of a simulator with the torque nearest to a model's.

A simulator has bodies, rotors, viscous and Coulomb friction. A model has more terms: Stribeck friction, friction that
grows with load, play, a correction. Without these, its coefficients of bodies and friction are not the best ones.
Learnt rotors and friction may also be negative. So all coefficients are fitted again, by least squares over the torque
in the range of the training. Bodies have to be possible; rotors and friction have to be at least zero.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lipcore.data.motion import Array, Indices, Motion
from lipcore.export.origin import draw_states
from lipcore.export.simulated_arm import SimulatedArm
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.base import State
from lipcore.kernels.drive.terms import SIGN_WIDTH
from lipcore.kernels.geometry import Geometry
from lipcore.kernels.newton_euler import rigid_body_features
from lipcore.model.parameters import weight_posterior
from lipcore.model.plausible import nearest_plausible
from lipcore.model.torque_model import TorqueModel
from lipcore.posterior.compression import checks
from lipcore.robots.urdf import PARAMETERS

STATES = 1000
"""States of the fit: one half in the region of the training's motion, one half anywhere in its range."""
RIDGE = 1e-2
"""Weight of a change by one prior standard deviation: it counts like an error of 10 % of the torque at one state. On
nine models of real and simulated arms, 1e-3 had the same errors, and larger masses."""
MAX_DENSITY = 1e4
"""Max density of a body, kg/m³: steel has 7 900. No body has smaller moments than a ball of this density."""
PASSES = 6
"""Max number of fits. The min size of the bodies follows from the masses of the previous fit."""
MIN_SHARE = 0.01
"""Min torque of a joint relative to the largest one: smaller errors do not matter."""
BARRIER = 1e-5
"""Last barrier, in squared errors relative to the torque. A coefficient whose best value is zero becomes about 1e-4 of
its scale. Errors of the same nine models were equal from 1e-8 to 1e-3."""


def fit_arm(model: TorqueModel, arm: SimulatedArm) -> SimulatedArm:
    """Return the arm with bodies, rotors, viscous and Coulomb friction fitted to the model's torque.

    arm: the model's, from `SimulatedArm.of_parameters`. The learnt constant torque of each joint, `offset`, is
    subtracted before: no joint of a simulator has one. Errors are relative to each joint's torque. Parameters that
    torque does not determine stay near those of `arm`. Of the geometries of `arm`, of the learnt bodies, and of the
    linearisation, the one with the smallest error is used. Raise ValueError for a model without rigid bodies.
    """
    term = model.estimator.terms.get("rigid_body")
    if not isinstance(term, ArmKernel):
        raise ValueError(f"estimator {model.estimator.name!r} has no rigid bodies")
    weights, order, n = weight_posterior(model.posterior, term), arm.order.astype(np.int64), model.n_joints
    motions = np.concatenate(
        [checks(model.posterior.basis.inducing, STATES // 2).arrays()[:, :3], draw_states(model, STATES // 2)]
    )
    motion = Motion.of(motions)
    tau = model.predict(motion.q, motion.dq, motion.ddq).mean[:, order] - arm.joints.offset
    spread = tau.std(axis=0)
    usual = np.maximum(spread, MIN_SHARE * spread.max())
    own = _own_terms(motion, order)
    size = PARAMETERS * n
    scale = np.concatenate(
        [
            weights.scale[:size].reshape(n, PARAMETERS)[order].reshape(-1),
            weights.scale[size : size + n][order],
            *(usual / np.maximum(np.sqrt(np.square(each).mean(axis=0)), 1e-9) for each in own[1:]),
        ]
    )
    joints = arm.joints
    start = np.concatenate([arm.bodies.reshape(-1), joints.rotor, joints.viscous, joints.coulomb])
    best, found = np.inf, arm
    for geometry in _geometries(term, arm, weights.mean):
        features = _features(geometry, motion, order, own) / usual[:, None]
        design = features.reshape(-1, features.shape[-1]) * scale
        metric = design.T @ design + RIDGE * np.eye(len(scale))
        slope = design.T @ (tau / usual).reshape(-1) + RIDGE * start / scale
        nearest = np.linalg.solve(metric, slope)
        spread, signed = _spread_of(arm.bodies[:, 0]), np.arange(size, len(scale))
        for _ in range(PASSES):  # with the masses found before
            fitted = nearest_plausible(nearest * scale, scale, metric, n, arm.bodies, signed, BARRIER, spread)
            needed = _spread_of(fitted[:size:PARAMETERS])
            if (needed <= 1.1 * spread).all():
                break
            spread = np.maximum(spread, needed)
        error = tau - (features @ fitted) * usual
        if (cost := float(np.square(error / usual).mean())) < best:
            best = cost
            found = _with_values(arm, geometry, fitted, np.sqrt(np.square(error).mean(axis=0)))
    return found


def _spread_of(mass: Array) -> Array:
    """Return the second moment of balls of MAX_DENSITY along each axis, relative to their mass, m². mass: kg."""
    return np.asarray(np.cbrt(0.75 * mass / (np.pi * MAX_DENSITY)) ** 2 / 5)


def _geometries(term: ArmKernel, arm: SimulatedArm, mean: Array) -> list[Geometry]:
    """Return the geometries to choose from: they are the same unless the model learns its geometry."""
    return [arm.geometry, term.geometry(mean), term.arm.geometry] if term.arm.steps else [arm.geometry]


def _own_terms(motion: Motion, order: Indices) -> Array:
    """Return the features of rotor, viscous and Coulomb friction at N motions, (3, N, n), base to tip."""
    parts = [motion.ddq, motion.dq, np.tanh(motion.dq / SIGN_WIDTH)]
    return np.stack(parts)[:, :, order]


def _features(geometry: Geometry, motion: Motion, order: Indices, own: Array) -> Array:
    """Return the features of bodies and of `_own_terms`, (N, n, 13 n), joints base to tip."""
    n = motion.n_joints
    bodies, _ = rigid_body_features(geometry, np.zeros((n, PARAMETERS)), State.paired(motion).ordered(order))
    diagonal = own.transpose(1, 2, 0)[..., None] * np.eye(n)[:, None]  # (N, n, 3, n)
    return np.concatenate([np.array(bodies).transpose(2, 1, 0), diagonal.reshape(len(motion), n, -1)], axis=2)


def _with_values(arm: SimulatedArm, geometry: Geometry, fitted: Array, error: Array) -> SimulatedArm:
    """Return the arm with fitted values, (13 n,). error: of each joint, root mean square, (n,)."""
    bodies, own = np.split(fitted, [arm.bodies.size])
    rotor, viscous, coulomb = own.reshape(3, -1)
    joints = replace(arm.joints, rotor=rotor, viscous=viscous, coulomb=coulomb)
    off = ", ".join(f"{value:.2g}" for value in error)
    note = (
        f"Without the offset, torque differs from the learnt torque by {off} N·m (N), root mean square in the range "
        "of the training, base to tip."
    )
    return replace(arm, geometry=geometry, bodies=bodies.reshape(-1, PARAMETERS), joints=joints, notes=(note,))
