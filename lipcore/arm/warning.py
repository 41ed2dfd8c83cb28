"""What to be careful with of a learnt arm, in sentences: what its recording leaves open, and how its fit ended."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from lipcore.kernels.arm import ArmKernel
from lipcore.motion import Motion
from lipcore.samples import Array

if TYPE_CHECKING:
    from lipcore.model import TorqueModel

ALWAYS_OPEN = 2
"""Numbers of a geometry that no torque depends on: its turn about gravity, and a place along the first axis."""
TOGETHER = 0.7
"""Independent motions, as a share of the joints, below which joints are said to move together."""
FARTHER = 2.0
"""How much farther, or faster, a joint moves than it did where alternative arms are compared."""
LISTED = 8
"""Joints that are named in a sentence, at most."""
COUNTS = {2: "Two", 3: "Three", 4: "Four"}


def warnings(model: TorqueModel, parameters: Mapping[str, Any]) -> list[str]:
    """Sentences about a model's arm, the gravest first; of a model without one, about the motion of its recording.

    parameters: the report of `lipcore.parameters.report`.
    """
    arm, fit = model.arm, model.fit
    moved = float(fit.get("motion_dimensions", model.n_joints))
    together = (
        f"Its joints moved together, like {moved:.1f} independent ones of {model.n_joints}: torque of other motion may "
        "be off by more than tau_std says. A recording in which each moves by itself tells more."
    )
    if arm is None:
        return [together] if moved < TOGETHER * model.n_joints else []
    out = []
    if len(arm.alternatives) > 1:
        out.append(_alternatives(model))
    if fit.get("search_ended") == "time":
        limit = float(model.options.get("search_seconds", 0.0))
        out.append(f"The search for the geometry ended at its time limit, {limit:g} s: a longer one may tell more.")
    if fit.get("search_explained") is False:
        more = "" if "energy" in model.estimator.terms else " Compare with rigid-body+lip-chain."
        out.append(
            f"Rigid bodies leave more of the torque than the sensor's noise: it holds more than they explain.{more}"
        )
    joints = parameters.get("geometry", {}).get("joints", ())
    names = {each["joint"]: each["undetermined"] for each in joints if each["undetermined"]}
    count = sum(map(len, names.values()))
    if count > ALWAYS_OPEN:
        listed = "; ".join([f"{joint}: {', '.join(each)}" for joint, each in names.items()][:LISTED])
        listed += "; …" if len(names) > LISTED else ""
        stand = "are the URDF's" if arm.mode == "calibrate" else "are only a guess"
        out.append(f"The recording does not tell {count} numbers of the geometry, which {stand} ({listed}).")
    if (count > ALWAYS_OPEN or arm.alternatives) and moved < TOGETHER * model.n_joints:
        out.append(together)
    return out


def _alternatives(model: TorqueModel) -> str:
    """How likely the alternative arms are, and which joint has to move farther or faster to tell them apart.

    Their spread is the standard deviation of their mixture, root mean square over the basis' motions with one joint
    FARTHER from the middle of its range, or that much faster; the joint is the one where it is largest for the noise.
    """
    term = model.estimator.terms["rigid_body"]
    assert isinstance(term, ArmKernel)
    motion, tried = model.posterior.basis.inducing, []
    low, high = (np.array(model.training_range["q"][end]) for end in ("min", "max"))
    fastest = np.abs([model.training_range["dq"][end] for end in ("min", "max")]).max(0)
    for joint, name in enumerate(model.joint_names):
        length = "m" if model.joint_types[joint] == "prismatic" else "rad"
        q, dq, ddq = (each.clone() for each in (motion.q, motion.dq, motion.ddq))
        middle = 0.5 * (low[joint] + high[joint])
        q[:, joint] = middle + FARTHER * (q[:, joint] - middle)
        dq[:, joint] *= FARTHER
        ddq[:, joint] *= FARTHER**2
        where = f"{name} leaves {low[joint]:.2g} to {high[joint]:.2g} {length}"
        tried.append((_spread(term, replace(motion, q=q)), where))
        where = f"{name} is faster than {fastest[joint]:.2g} {length}/s"
        tried.append((_spread(term, replace(motion, dq=dq, ddq=ddq)), where))
    spread, where = max(tried, key=lambda each: float((each[0] / model.noise_std).max()))
    most = int((spread / model.noise_std).argmax())
    unit = "N" if model.joint_types[most] == "prismatic" else "N·m"
    shares = sorted((each.probability for each in term.arm.alternatives), reverse=True)
    percent = " and ".join(", ".join(f"{share:.0%}" for share in shares).rsplit(", ", 1))
    return (
        f"{COUNTS.get(len(shares), str(len(shares)))} arms explain the recording about as well ({percent}); their "
        f"difference is in tau_std. A recording in which {where} would tell: at twice that they differ by "
        f"{spread[most]:.2g} {unit} in {model.joint_names[most]}."
    )


def _spread(term: ArmKernel, motion: Motion) -> Array:
    """Standard deviation of the mixture of alternative arms, root mean square over motions: (n,)."""
    features = term.features(motion).numpy()[:, :, term.steps.stop :]
    return np.asarray(np.sqrt(np.mean(np.square(features).sum(2), axis=0)))
