"""How an upload is to be read and prepared: the query of its route, and what the command line passes on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from lipcore.preparation.recipe import Recipe
from lipcore.vocabulary import TorqueConvention

Effort = Literal["measured", "commanded", "current"]
"""What the effort of a recording is: measured torque, gravity included; commanded torque, what is added to gravity
compensation; motor current, A, that torque constants turn into torque."""
EFFORT_CONVENTIONS: Mapping[Effort, TorqueConvention] = {
    "measured": "gravity_included",
    "commanded": "gravity_compensated",
    "current": "gravity_included",
}


@dataclass(frozen=True)
class ReadOptions:
    """How a file becomes columns. All may be None: then it is found out, or the robot says.

    columns: for t, episode, q, dq, ddq, tau what its columns are called: a pattern with `{joint}`, or a list; units: of
    these by name; topic: of a bag; delimiter: of a CSV; joint_names: of joints 1..n; effort: what tau is;
    torque_constants: N·m/A a joint, of motor currents.
    """

    columns: Mapping[str, str | tuple[str, ...]] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    topic: str | None = None
    delimiter: str | None = None
    joint_names: tuple[str, ...] | None = None
    effort: Effort | None = None
    torque_constants: tuple[float, ...] | None = None


@dataclass(frozen=True)
class UploadOptions:
    """What an upload is taken as.

    robot: a profile's name or the id of an uploaded URDF; torque_convention: None takes that of the effort; joints:
    those to keep, in this order, None keeps all; drop_joints: those to leave out, which then must not move.
    """

    read: ReadOptions = field(default_factory=ReadOptions)
    recipe: Recipe = field(default_factory=Recipe)
    robot: str | None = None
    torque_convention: TorqueConvention | None = None
    joints: tuple[str, ...] | None = None
    drop_joints: tuple[str, ...] = ()
