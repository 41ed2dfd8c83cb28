"""Origin of an exported file, and the states of its self-test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lipcore.data.motion import Array
from lipcore.model.torque_model import TorqueModel

SELF_TEST_STATES = 100


@dataclass(frozen=True)
class ModelOrigin:
    """Origin of the exported files. model: name; version, revision: numbers; digest: of the model's tensors."""

    model: str
    version: int
    revision: int
    digest: str

    @property
    def stem(self) -> str:
        """Name of files, without ending."""
        return f"{self.model}-v{self.version}" + (f"-r{self.revision}" if self.revision else "")


def draw_states(model: TorqueModel, count: int = SELF_TEST_STATES) -> Array:
    """Return states within the range of the training, (count, 3, n), the same at every call.

    They have seven significant digits, which keeps files short.
    """
    limits, draw = model.training_range, np.random.default_rng(0).uniform
    states = [draw(limits[name]["min"], limits[name]["max"], (count, model.n_joints)) for name in ("q", "dq", "ddq")]
    return np.array([float(f"{value:.7g}") for value in np.stack(states, axis=1).flat]).reshape(count, 3, -1)
