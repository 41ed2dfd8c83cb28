"""The torque that a simulator's joint cannot express: by term, its largest value over the range of the training."""

from __future__ import annotations

import numpy as np

from lipcore.data.motion import Array, Motion
from lipcore.export.origin import draw_states
from lipcore.export.simulated_arm import SimulatedArm
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.drive.kernel import DriveKernel
from lipcore.kernels.drive.terms import BASE_TERMS, KIND_TERMS, SIGN_WIDTH
from lipcore.model.parameters import weight_posterior
from lipcore.model.torque_model import TorqueModel

STATES = 1000
NEGLIGIBLE = 1e-6
"""Share of a joint's usual torque below which an error is stated as zero."""
CURVE = ("stribeck", "speed", "sides")
"""Kinds of friction that are a curve of speed, which a simulator replaces by a line."""


def torque_shortfall(model: TorqueModel, arm: SimulatedArm, *, has_offset: bool = False) -> dict[str, Array]:
    """Return the largest torque error of an arm in a simulator, by term, (n,) N·m (N), in the order of the data.

    - `offset`: the constant torque; zero if the simulator's motors have it (`has_offset`).
    - `friction curve`: friction as a function of speed minus viscous and Coulomb friction (Stribeck, cubic).
    - `position`, `load`, `gain`, `play`: as in `lipcore.kernels.drive.terms`. For `play`, a bound: an element that
      has just turned back differs from one that slips by twice its torque.
    - `correction`: the learnt torque beyond rigid bodies and drive.
    - `bodies`: the difference of the plausible bodies from the learnt ones.
    - `all`: the difference from the model's torque, which does not know the motion before a state.

    Fitted friction replaces a part of the terms that a simulator lacks, so that errors of several terms partly cancel.
    The Coulomb sign is smoothed as in the model: at standstill a simulator's friction takes any value in between.
    Raise ValueError for an estimator without rigid bodies.
    """
    drive, body = model.estimator.terms["friction"], model.estimator.terms.get("rigid_body")
    if not isinstance(drive, DriveKernel) or not isinstance(body, ArmKernel):
        raise ValueError(f"estimator {model.estimator.name!r} has no rigid bodies")
    motions = draw_states(model, STATES)
    motion, n = Motion.of(motions), model.n_joints
    weights = weight_posterior(model.posterior, drive).mean.reshape(n, -1)
    each = dict(zip(drive.drive.terms, np.moveaxis(drive.drive.by_joint(motions) * weights, 2, 0), strict=True))
    offset = arm.offset_torque()
    friction = arm.friction_torque(motion.dq, np.tanh(motion.dq / SIGN_WIDTH))
    curve = sum(each[term] for term in (*BASE_TERMS, *_terms(CURVE, drive))) - offset - friction
    slipped = weights[:, [name.startswith("play_") for name in drive.drive.terms]]
    if slipped.size:  # Coulomb friction includes the elements, which have slipped in steady motion
        curve = curve + slipped.sum(axis=1) * np.tanh(motion.dq / SIGN_WIDTH)
    learnt = body.features(motion) @ weight_posterior(model.posterior, body).mean
    tau = model.predict(motion.q, motion.dq, motion.ddq).tau
    bodies = arm.bodies_torque(motions)
    expressed = has_offset * offset
    errors = {"offset": (offset - expressed)[None], "friction curve": curve}
    errors |= {
        kind: np.sum([each[term] for term in _terms((kind,), drive)], axis=0)
        for kind in ("position", "load", "gain")
        if kind in drive.drive.kinds
    }
    errors["play"] = 2 * np.abs(slipped).sum(axis=1)[None]
    errors["correction"] = tau - learnt - np.sum(list(each.values()), axis=0)
    errors |= {"bodies": learnt - bodies, "all": tau - bodies - friction - expressed}
    largest = {name: np.abs(error).max(axis=0) for name, error in errors.items()}
    return {name: np.where(error > NEGLIGIBLE * model.scale, error, 0.0) for name, error in largest.items()}


def _terms(kinds: tuple[str, ...], drive: DriveKernel) -> list[str]:
    """Return the names of a drive's terms of these kinds."""
    return [term for kind in drive.drive.kinds if kind in kinds for term in KIND_TERMS[kind]]
