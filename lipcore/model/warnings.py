"""Warnings about a model: joints that fall back, parameters that the recording does not identify, and failed fits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.fast.arm import PARAMETERS
from lipcore.model import texts
from lipcore.model.parameters import weight_posterior
from lipcore.model.torque_model import TorqueModel
from lipcore.posterior.compression import checks

RANGE_FACTOR = 2.0
"""Factor on the range and speed of the recording, at which alternative arms and shares of the fallback are compared."""
MIN_GAIN_ERROR = 0.03
"""Min error of a gain for a warning, if it also exceeds two of its standard deviations."""
MIN_MOUNTING_DEG = 2.0
"""The same for the tilt of the base and the zeros of joints."""
REFIT_ERROR = "refit_error"
"""Entry of a fit's report: the error of the last fit, on all rows."""


def linearisation_error(model: TorqueModel) -> Array | None:
    """Return the error of an arm's linearised torque relative to the stated error, root mean square over motions, (n,).

    With weights w, linearised at ŵ = (π̂, r, 0), and their features Φ (without alternative arms), it is

        Y(θ + δθ) π + r ∘ ddq − Φ w    over    √(tau_std² + noise_std²)    at    w = ŵ + (I − C Λ⁻¹) (μ − ŵ)

    where μ and C are posterior mean and covariance, and Λ the prior's. This is the part of the step towards μ that
    samples determine. In the other directions μ is arbitrary, because no torque depends on it. The motions are those of
    the basis. Return None for a model without an arm, or with a fixed geometry: its torque is linear.
    """
    term = model.estimator.terms.get("rigid_body")
    if not isinstance(term, ArmKernel) or not term.arm.steps:
        return None
    arm, posterior, n = term.arm, model.posterior, term.n_joints
    motion = checks(posterior.basis.inducing, 40)
    known, used = weight_posterior(posterior, term), term.steps.stop
    centre = known.mean.copy()
    centre[: PARAMETERS * n], centre[term.steps] = arm.parameters[arm.place].reshape(-1), 0.0
    step = known.mean - centre
    weights = centre + step - known.covariance @ (step / known.scale**2) / posterior.std_factor**2
    linear = term.features(motion)[:, :, :used] @ weights[:used]
    std = model.evaluator.many(motion.q, motion.dq, motion.ddq)[1]
    error = term.torque(weights, motion) - linear
    return np.asarray(np.sqrt(np.mean(error**2 / (std**2 + model.noise_std**2), axis=0)))


def warnings(model: TorqueModel, parameters: Mapping[str, Any]) -> list[str]:
    """Return sentences about a model: joints that fall back, then its arm, the most severe first.

    For a model without an arm, they are about the motion of its recording. parameters: the report of
    `lipcore.model.parameters.report`.
    """
    arm, fit, out = model.arm, model.fit, _fallback(model)
    if REFIT_ERROR in fit:
        out.append(texts.describe_failed_fit(str(fit[REFIT_ERROR])))
    moved = float(fit.get("motion_dimensions", model.n_joints))
    together = texts.describe_dependent_motion(moved, model.n_joints) if moved else texts.STANDSTILL
    moved_together = moved < 0.7 * model.n_joints
    if arm is None:
        return [*out, together] if moved_together else out
    if len(arm.alternatives) > 1:
        out.append(_alternatives(model))
    if gains := _wrong_gains(model, parameters):
        out.append(texts.describe_gains(gains))
    out += _mounting(model, parameters)
    if fit.get("search_ended") == "time":
        out.append(texts.describe_search_limit(float(model.options.get("search_seconds", 0.0))))
    if fit.get("search_explained") is False:
        out.append(texts.describe_unmodelled_torque("energy" in model.estimator.terms))
    joints = parameters.get("geometry", {}).get("joints", ())
    names = {each["joint"]: each["undetermined"] for each in joints if each["undetermined"]}
    # no torque depends on the geometry's turn about gravity and its place along the first axis
    several = sum(map(len, names.values())) > 2
    if several:
        out.append(texts.describe_unidentifiable(names, arm.mode == "calibrate"))
    if (several or arm.alternatives) and moved_together:
        out.append(together)
    return out


def _wrong_gains(model: TorqueModel, parameters: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """Return mean and standard deviation of the errors of wrong gains, by joint."""
    gain = parameters.get("friction", {}).get("gain", {"mean": (), "std": ()})
    found = zip(model.joint_names, gain["mean"], gain["std"], strict=False)
    return {joint: (mean, std) for joint, mean, std in found if abs(mean) > max(MIN_GAIN_ERROR, 2 * std)}


def _mounting(model: TorqueModel, parameters: Mapping[str, Any]) -> list[str]:
    """Return sentences about a mounting that differs from the URDF's."""
    fit, out = model.fit, []
    if "mounting" in fit:
        out.append(texts.describe_mounting(str(fit["mounting"])))
    if (tilt := float(fit.get("base_tilt", 0.0))) > MIN_MOUNTING_DEG:
        std = float(np.degrees(np.linalg.norm(parameters["geometry"]["joints"][0]["turn_std"])))
        if tilt > 2 * std:
            out.append(texts.describe_tilt(tilt, std))
    zeros = {}
    for joint, (name, kind) in enumerate(zip(model.joint_names, model.joint_types, strict=True), start=1):
        mean, std = (float(fit.get(f"{key}{joint}", 0.0)) for key in ("zero_", "std_of_zero_"))
        if kind == "revolute" and abs(mean) > max(MIN_MOUNTING_DEG, 2 * std):
            zeros[name] = mean, std
    if zeros:
        out.append(texts.describe_zeros(zeros))
    return out


def _fallback(model: TorqueModel) -> list[str]:
    """Return a sentence with the joints that mostly fall back at motions farther and faster than recorded.

    The motions are recombined from those of the basis, and scaled by RANGE_FACTOR.
    """
    motion = checks(model.posterior.basis.inducing, 40)[-20:]
    low, high = (np.array(model.training_range["q"][end]) for end in ("min", "max"))
    middle = 0.5 * (low + high)
    q = middle + RANGE_FACTOR * (motion.q - middle)
    share = model.evaluator.many(q, RANGE_FACTOR * motion.dq, RANGE_FACTOR**2 * motion.ddq)[3]
    if share is None:
        return []
    names = [name for name, often in zip(model.joint_names, (share > 0).mean(axis=0), strict=True) if often > 0.5]
    return [texts.describe_fallback(names, RANGE_FACTOR)] if names else []


def _alternatives(model: TorqueModel) -> str:
    """Return a sentence with the probabilities of alternative arms, and the joint that would distinguish them.

    Their spread is the standard deviation of their mixture, root mean square over the basis' motions. In these, one
    joint moves RANGE_FACTOR times farther from the middle of its range, or that much faster. The joint is the one with
    the largest spread relative to noise.
    """
    term = model.estimator.terms["rigid_body"]
    assert isinstance(term, ArmKernel)
    motion, tried = model.posterior.basis.inducing, []
    low, high = (np.array(model.training_range["q"][end]) for end in ("min", "max"))
    fastest = np.abs([model.training_range["dq"][end] for end in ("min", "max")]).max(0)
    for joint, name in enumerate(model.joint_names):
        length = "m" if model.joint_types[joint] == "prismatic" else "rad"
        q, dq, ddq = (each.copy() for each in (motion.q, motion.dq, motion.ddq))
        middle = 0.5 * (low[joint] + high[joint])
        q[:, joint] = middle + RANGE_FACTOR * (q[:, joint] - middle)
        dq[:, joint] *= RANGE_FACTOR
        ddq[:, joint] *= RANGE_FACTOR**2
        where = f"{name} leaves the range {low[joint]:.2g} to {high[joint]:.2g} {length}"
        tried.append((_spread(term, replace(motion, q=q)), where))
        where = f"{name} moves faster than {fastest[joint]:.2g} {length}/s"
        tried.append((_spread(term, replace(motion, dq=dq, ddq=ddq)), where))
    spread, where = max(tried, key=lambda each: float((each[0] / model.noise_std).max()))
    most = int((spread / model.noise_std).argmax())
    unit = "N" if model.joint_types[most] == "prismatic" else "N·m"
    shares = sorted((each.probability for each in term.arm.alternatives), reverse=True)
    return texts.describe_alternatives(shares, where, f"{spread[most]:.2g} {unit}", model.joint_names[most])


def _spread(term: ArmKernel, motion: Motion) -> Array:
    """Return the standard deviation of the mixture of alternative arms, root mean square over motions, (n,)."""
    features = term.features(motion)[:, :, term.steps.stop :]
    return np.asarray(np.sqrt(np.mean(np.square(features).sum(2), axis=0)))
