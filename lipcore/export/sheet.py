"""What an exported robot description carries: its origin, its largest errors, and a self-test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lipcore.data.motion import Array
from lipcore.export.origin import ModelOrigin, draw_states
from lipcore.export.shortfall import torque_shortfall
from lipcore.export.simulated_arm import SimulatedArm
from lipcore.model.torque_model import TorqueModel

UNITS = {"revolute": "rad, rad/s, rad/s^2, N m", "prismatic": "m, m/s, m/s^2, N"}
"""Units of position, velocity, acceleration and torque of a joint."""


def describe_model(model: TorqueModel, origin: ModelOrigin, order: Sequence[int] | None = None) -> dict[str, Any]:
    """Return origin, joints and units of a model. order: places of the joints, if not those of the data."""
    joints = range(model.n_joints) if order is None else order
    return {
        "model": origin.model,
        "version": origin.version,
        "revision": origin.revision,
        "sha256": origin.digest,
        "joints": [model.joint_names[joint] for joint in joints],
        "units": [UNITS[model.joint_types[joint]] for joint in joints],
        "torque": model.torque_convention,
    }


@dataclass(frozen=True)
class Sheet:
    """Facts about an exported arm, joints base to tip as in the file."""

    about: dict[str, Any]
    """Model, version, revision, hash, joints, units, and `max_error` of each joint by term, N·m (N)."""
    self_test: dict[str, list[list[float]]]
    """States q, dq, ddq; the torque `tau` of the file, with sign(dq) as Coulomb sign; `model_tau` of the model."""

    @classmethod
    def of(cls, model: TorqueModel, arm: SimulatedArm, origin: ModelOrigin, *, has_offset: bool = False) -> Sheet:
        """Return the facts about the arm of a model. has_offset: whether its motors have the learnt offset."""
        order, names = arm.order, arm.joints.names
        errors = torque_shortfall(model, arm, has_offset=has_offset)
        about = describe_model(model, origin, [int(joint) for joint in order]) | {
            "max_error": {
                name: {term: float(f"{error[joint]:.3g}") for term, error in errors.items() if error[joint]}
                for name, joint in zip(names, order, strict=True)
            },
        }
        motions = draw_states(model)
        q, dq, ddq = motions.swapaxes(0, 1)
        tau = arm.bodies_torque(motions) + arm.friction_torque(dq, np.sign(dq)) + has_offset * arm.offset_torque()
        columns = {"q": q, "dq": dq, "ddq": ddq, "tau": tau, "model_tau": model.predict(q, dq, ddq).tau}
        return cls(about, {name: _rounded(values[:, order]) for name, values in columns.items()})

    def joint_note(self, k: int) -> str:
        """Return the comment about the torque that joint k cannot express."""
        errors = self.about["max_error"][self.about["joints"][k]]
        listed = ", ".join(f"{term} {error:g}" for term, error in errors.items()) or "0"
        return f"largest torque error in the range of the training: {listed}"


def _rounded(values: Array) -> list[list[float]]:
    return [[float(f"{value:.10g}") for value in row] for row in values]
