"""What an exported function carries: its origin, its arguments, and a self-test."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from lipcore.data.motion import Array
from lipcore.export.function import TorqueFunction
from lipcore.export.origin import ModelOrigin, draw_states
from lipcore.export.sheet import describe_model
from lipcore.kernels.drive.play import element_widths
from lipcore.model.torque_model import TorqueModel

RESULTS = ("tau", "tau_std")
MEMORY_NOTE = (
    "drive_state has the rows: last position; lower and upper bounds of each element, -1 and 1 if unknown. "
    "After a small motion to q: bounds = clip(bounds + (q - last position) / drive_widths, -1, 1)."
)


@dataclass(frozen=True)
class FunctionSheet:
    """Facts about an exported function of N states."""

    about: dict[str, Any]
    """Model, version, revision, hash, joints, units, and the shapes of arguments and results."""
    arguments: dict[str, tuple[int, ...]]
    """Names of the arguments, with their shapes after the batch: (n,), or (1 + 2 K, n) for `drive_state`."""
    self_test: dict[str, Array]
    """Arguments and results of 100 states, with the batch first."""

    @classmethod
    def of(cls, model: TorqueModel, answer: TorqueFunction, origin: ModelOrigin) -> FunctionSheet:
        """Return the facts about a model's function."""
        n, states = model.n_joints, draw_states(model)
        values = dict(zip(("q", "dq", "ddq"), np.ascontiguousarray(states.swapaxes(0, 1)), strict=True))
        about = describe_model(model, origin)
        if answer.remembers:
            widths = element_widths(model.joint_types)
            values["drive_state"] = _drawn_memory(values["q"], len(widths))
            about |= {"drive_widths": widths.tolist(), "drive_state": MEMORY_NOTE}
        arguments = {name: value.shape[1:] for name, value in values.items()}
        about["arguments"] = {name: ["batch", *shape] for name, shape in arguments.items()}
        about["results"] = {name: ["batch", n] for name in RESULTS}
        return cls(about, arguments, values | dict(zip(RESULTS, answer(*values.values()), strict=True)))

    def json(self) -> str:
        """Return the facts and the self-test as JSON."""
        tests = {name: value.tolist() for name, value in self.self_test.items()}
        return json.dumps({**self.about, "self_test": tests}, allow_nan=False) + "\n"


def _drawn_memory(q: Array, elements: int) -> Array:
    """Return states of the drive at positions q: unknown at every second one, (N, 1 + 2 K, n)."""
    draw = np.random.default_rng(1).uniform
    low = draw(-1.0, 1.0, (len(q), elements, q.shape[1]))
    high = draw(low, 1.0)
    low[::2], high[::2] = -1.0, 1.0
    return np.concatenate([q[:, None], low, high], axis=1)
