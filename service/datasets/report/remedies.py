"""How an upload was read, and the options that correct its faults."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lipcore.profiles import profile
from service.contract.datasets import Cause, Remedy
from service.datasets.mapping.choice import format_numbers as numbers
from service.datasets.report.fault_texts import with_options


@dataclass(frozen=True)
class Upload:
    """How a recording was read."""

    names: tuple[str, ...]
    """Joints of the data."""
    gravity: bool
    """Whether torques were read as torques with gravity."""
    source: Mapping[str, Any] | None
    """How the columns were read, as in `Recording.facts`; None if unknown."""

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.names)

    @property
    def effort(self) -> str | None:
        """What the torque column was read as, see `Effort`."""
        return None if self.source is None else self.source["effort"]

    def scaled_torque(self, by: Sequence[float]) -> dict[str, str]:
        """Return options that multiply the torques by further factors (n,)."""
        before = (self.source or {}).get("torque_factors") or [1.0] * self.n_joints
        return {"torque_factors": _joined([a * b for a, b in zip(before, by, strict=True)])}

    def torque_constants(self, by: Sequence[float]) -> dict[str, str]:
        """Return options that read the torques as motor currents.

        by: torque constants (n,), N·m/A, which the constants of the upload, if any, are multiplied by.
        """
        before = (self.source or {}).get("torque_constants") or [1.0] * self.n_joints
        return {"effort": "current", "torque_constants": _joined([a * b for a, b in zip(before, by, strict=True)])}

    def robot(self, name: str) -> dict[str, str]:
        """Return options that name a robot, and keep measured torque if the robot's default is another effort."""
        other = self.effort == "measured" and profile(name).effort in ("current", "commanded")
        return {"robot": name, **({"effort": "measured"} if other else {})}

    def torque_columns(self, column: Sequence[int]) -> dict[str, str] | None:
        """Return options that read torque from other columns, or None if joints were left out.

        column: for each joint, the joint with its torque in the column, (n,).
        """
        if self.source is None or self.source["dropped_joints"]:
            return None
        names = self.source["columns"]["tau"]
        return {"columns": json.dumps({"tau": self._in_file([str(names[k]) for k in column])}, ensure_ascii=False)}

    def joint_names(self, names: Sequence[str]) -> dict[str, str] | None:
        """Return options that rename the joints, (n,), or None if joints were left out."""
        if self.source is None or self.source["dropped_joints"]:
            return None
        return {"joint_names": ",".join(self._in_file(names))}

    def _in_file(self, values: Sequence[str]) -> list[str]:
        """Return values of the joints in the file's order."""
        assert self.source is not None
        return [values[joint] for joint in np.argsort(self.source["places"])]


def _joined(values: Sequence[float]) -> str:
    return numbers(values).replace(" ", "")


def make_remedy(
    cause: Cause,
    joints: Sequence[str],
    text: str,
    options: dict[str, str] | None = None,
    only_if: str | None = None,
) -> Remedy:
    """Return a fault with its correction.

    options: query parameters of an upload. only_if: condition under which the correction is right.
    """
    if options is not None:
        text = with_options(text, options, only_if)
    return Remedy(cause=cause, joints=list(joints), text=text, options=options)
