"""What an upload was read as, and the options that put right what is wrong with it."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lipcore.profiles import profile
from service.contract.datasets import Cause, Remedy
from service.datasets.mapping.choice import listed as numbers


@dataclass(frozen=True)
class Upload:
    """What a recording was read as.

    names: of the data's joints; gravity: whether torques are to contain it; source: what the columns were taken as, see
    `reading.read`, None where nothing is known.
    """

    names: tuple[str, ...]
    gravity: bool
    source: Mapping[str, Any] | None

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.names)

    @property
    def effort(self) -> str | None:
        """What the torque was taken as."""
        return None if self.source is None else self.source["effort"]

    def factors(self, by: Sequence[float]) -> dict[str, str]:
        """Options that multiply the torques once more, by (n,)."""
        before = (self.source or {}).get("torque_factors") or [1.0] * self.n_joints
        return {"torque_factors": _joined([a * b for a, b in zip(before, by, strict=True)])}

    def constants(self, by: Sequence[float]) -> dict[str, str]:
        """Options that take the torques for currents of these constants (n,), N·m/A, times the upload's if any."""
        before = (self.source or {}).get("torque_constants") or [1.0] * self.n_joints
        return {"effort": "current", "torque_constants": _joined([a * b for a, b in zip(before, by, strict=True)])}

    def robot(self, name: str) -> dict[str, str]:
        """Options that name a robot, and keep measured torque for what it is where the robot's drivers give others."""
        other = self.effort == "measured" and profile(name).effort in ("current", "commanded")
        return {"robot": name, **({"effort": "measured"} if other else {})}

    def torque_columns(self, column: Sequence[int]) -> dict[str, str] | None:
        """Options that read the torque of joint j from the column that joint column[j] has, (n,); None where joints
        were left out."""
        if self.source is None or self.source["dropped_joints"]:
            return None
        names = self.source["columns"]["tau"]
        return {"columns": json.dumps({"tau": self._in_file([str(names[k]) for k in column])}, ensure_ascii=False)}

    def joint_names(self, names: Sequence[str]) -> dict[str, str] | None:
        """Options that call the joints so, (n,); None where joints were left out."""
        if self.source is None or self.source["dropped_joints"]:
            return None
        return {"joint_names": ",".join(self._in_file(names))}

    def _in_file(self, values: Sequence[str]) -> list[str]:
        """Values of the joints in the file's order."""
        assert self.source is not None
        return [values[joint] for joint in np.argsort(self.source["places"])]


def _joined(values: Sequence[float]) -> str:
    return numbers(values).replace(" ", "")


def remedy(cause: Cause, joints: Sequence[str], text: str, options: dict[str, str] | None = None) -> Remedy:
    """A cause in words, with the options as the command line takes them."""
    if options is not None:
        text += f": upload it with `{flags(options)}`"
    return Remedy(cause=cause, joints=list(joints), text=text, options=options)


def flags(options: Mapping[str, str]) -> str:
    """Options of an upload as the command line takes them."""
    out = []
    for name, value in options.items():
        if name == "columns":
            named = (f"{quantity}={','.join(columns)}" for quantity, columns in json.loads(value).items())
            out += [f"--column {shlex.quote(each)}" for each in named]
        else:
            out.append(f"--{name.replace('_', '-')}{'=' if value.startswith('-') else ' '}{shlex.quote(value)}")
    return " ".join(out)
