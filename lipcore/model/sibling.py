"""The prior of another unit of the same robot, from a trained model.

Units of one type have the same geometry except for machining, nearly the same masses, and their own friction. If a
parameter has the posterior N(m, V), that of another unit has the prior

    N(m, V + (0.1 · size)²),    size² = mean of m² + V over the entries of its kind and body,

and that of the geometry includes the tolerance of machining. V is the variance given all other parameters, 1 / Λ_ii of
the posterior precision Λ. Among independent Gaussians these are nearest to the posterior (in KL(q | p)). Sums that
torque determines stay as certain as the sums are, instead of as uncertain as their parts. Friction and noise are not
transferred.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lipcore.data.samples import Array
from lipcore.kernels.arm import SCALES, ArmKernel
from lipcore.kernels.arm_prior import KINDS, Arm, widths_of
from lipcore.kernels.fast.arm_recursion import PARAMETERS
from lipcore.model.parameters import precision, weight_posterior
from lipcore.model.torque_model import TorqueModel


def arm_of_sibling(base: TorqueModel) -> Arm:
    """Return the arm of another unit of a model's robot, before any samples of it. Its geometry may be calibrated.

    Raise ValueError for a model without an arm.
    """
    term = base.estimator.terms.get("rigid_body")
    if not isinstance(term, ArmKernel):
        raise ValueError(f"estimator {base.estimator.name!r} has no arm")
    arm, n = term.arm, term.n_joints
    weights = weight_posterior(base.posterior, term)
    variance = weights.scale**2 / precision(base.posterior, term).diagonal()
    bodies, rotors = slice(0, PARAMETERS * n), slice(PARAMETERS * n, (PARAMETERS + 1) * n)
    size = _sizes(weights.mean**2 + weights.std**2, n)
    unit = np.sqrt(variance[: rotors.stop] + (0.1 * size) ** 2)
    geometry = term.geometry(weights.mean)
    machined = widths_of(geometry)
    steps = variance[term.steps] if arm.steps else np.zeros(geometry.size)
    means = weights.mean[bodies].reshape(n, PARAMETERS)[arm.order]
    return Arm(
        geometry,
        arm.order,
        "calibrate",
        means,
        means,
        unit,
        weights.mean[rotors],
        np.zeros(geometry.size),
        np.sqrt(steps + machined**2),
    )


def arm_as_expected(arm: Arm) -> Arm:
    """Return the prior arm of a transferred arm, for another training of the same unit."""
    geometry = arm.geometry.moved(arm.expected) if arm.steps else arm.geometry
    return replace(arm, geometry=geometry, expected=np.zeros(arm.steps), drive=(), alternatives=())


def _sizes(squares: Array, n: int) -> Array:
    """Return the root mean square of each kind of parameter of a body, (11 n,). squares: of the weights, (p,)."""
    bodies, rotors = squares[: PARAMETERS * n].reshape(n, PARAMETERS), squares[PARAMETERS * n : (PARAMETERS + 1) * n]
    kinds = np.array(KINDS)
    means = np.stack([bodies[:, kinds == kind].mean(axis=1) for kind in range(SCALES - 1)], axis=1)
    return np.asarray(np.sqrt(np.concatenate([means[:, kinds].reshape(-1), rotors])))
