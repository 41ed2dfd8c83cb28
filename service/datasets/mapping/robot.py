"""What reading a recording needs to know of a robot."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol


class Robot(Protocol):
    """A profile: `lipcore.profiles.Profile` is one."""

    @property
    def name(self) -> str:
        """What the robot is called."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of its joints, from base to tip."""

    @property
    def effort(self) -> str:
        """What its effort field holds: measured or commanded torque, current, or unknown."""

    @property
    def torque_constants(self) -> Iterable[float] | None:
        """N·m/A of its joints, where known."""

    def order_of(self, names: Sequence[str]) -> list[int] | None:
        """Places of its joints among these names, from base to tip; None where they are not this robot's."""
