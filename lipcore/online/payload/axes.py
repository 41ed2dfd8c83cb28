"""Find axes with a wrong direction: without a payload their joints bore almost no torque in training."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

from lipcore.arm.right_angles import DIRECTIONS
from lipcore.online.payload.draws import Energy, Point, descent


@dataclass(frozen=True)
class AxisOptions:
    """When axes are turned, and which."""

    max_misfit: float = 2.0
    """Mean square of the rows' whitened errors, beyond which axes are turned. Tuned on simulated UR10 (`maxwell`, seeds
    0, 2, 3, 11, 13 and 17): 2.6 to 10 with wrong axes, 1 to 1.8 with better ones."""
    joints: int = 3
    """Number of the last axes that are turned, those of a wrist."""
    steps: int = 15
    """Max steps of a descent."""
    min_gain_nats: float = 10.0
    """Min gain, for errors of a mean square of one, that is more than chance."""


OPTIONS = AxisOptions()


def turn_axes(problem: Energy, at: Point, least: float) -> Generator[None, None, list[Point]]:
    """Return the arms with axes in other directions that explain the rows far better, the best first; often none.

    From the tip inwards, each axis is tried in six directions, until the arm explains the rows. The arms returned are
    those with its last axis turned that are not far less likely than the best. Yield after each step.

    at: as learnt, with the payload that is most likely then; least: energy of the most likely arm known, nats.
    """
    found: list[Point] = []
    for joint in reversed(range(at.place.geometry.n_joints)[-OPTIONS.joints :]):
        if at.misfit <= OPTIONS.max_misfit:
            break
        tried = []
        for direction in range(len(DIRECTIONS)):
            turned = problem.at(at.place.with_axis(joint, direction))
            tried.append((yield from descent(problem, turned, OPTIONS.steps)))
        best = min(tried, key=lambda each: each.energy)
        if at.energy - best.energy > OPTIONS.min_gain_nats * max(1.0, at.misfit):
            found = [best, *(each for each in tried if 0 < each.energy - best.energy < OPTIONS.min_gain_nats)]
            at = best
    return found if at.energy < least - OPTIONS.min_gain_nats * max(1.0, at.misfit) else []
