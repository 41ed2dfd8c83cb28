"""How far an arm's weights have moved from where its torque was taken as linear."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lipcore.compact.compress import checks
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.compiled.arm import PARAMETERS
from lipcore.parameters import weight_posterior
from lipcore.samples import Array

if TYPE_CHECKING:
    from lipcore.model import TorqueModel

QUERIES = 40
"""Motions that are looked at: half of the basis' own, half recombined from them."""


def linearisation_error(model: TorqueModel) -> Array | None:
    """Error of taking an arm's torque as linear, in units of what is stated, root mean square over motions: (n,).

    With weights w, linear around ŵ = (π̂, r, 0), and Φ their features (alternative arms left out), it is

        Y(θ + δθ) π + r ∘ ddq − Φ w    over    √(tau_std² + noise_std²)    at    w = ŵ + (I − C Λ⁻¹) (μ − ŵ)

    where μ and C are posterior mean and covariance, Λ the prior's: the step towards μ as far as samples have told it.
    Along what they leave open μ may lie anywhere, for no torque depends on it. The motions are those that the basis
    keeps. None for a model without an arm, or with a geometry that is fixed: it is linear.
    """
    term = model.estimator.terms.get("rigid_body")
    if not isinstance(term, ArmKernel) or not term.arm.steps:
        return None
    arm, posterior, n = term.arm, model.posterior, term.n_joints
    motion = checks(posterior.basis.inducing, 0, QUERIES)
    known, used = weight_posterior(posterior, term), term.steps.stop
    centre = known.mean.copy()
    centre[: PARAMETERS * n], centre[term.steps] = arm.parameters[arm.place].reshape(-1), 0.0
    step = known.mean - centre
    weights = centre + step - known.covariance @ (step / known.scale**2) / posterior.std_factor**2
    linear = term.features(motion).numpy()[:, :, :used] @ weights[:used]
    answer = posterior.predict(motion)
    stated = answer.covariance.diagonal(dim1=1, dim2=2).clamp_min(0.0) + posterior.noise_variance
    error = term.torque(weights, motion) - linear
    return np.asarray(np.sqrt(np.mean(error**2 / stated.numpy(), axis=0)))
