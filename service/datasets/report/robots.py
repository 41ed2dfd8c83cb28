"""Recognition of the recording's robot by joint names and by the torque that gravity needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lipcore.extras import MissingExtraError
from lipcore.profiles import Profile, profile, profiles, recognise
from service.contract.datasets import Remedy
from service.datasets.report import texts
from service.datasets.report.bodies import Bodies, Comparison, Signals, compare
from service.datasets.report.remedies import Upload, make_remedy
from service.datasets.report.signals import limits_of


@dataclass(frozen=True)
class MatchOptions:
    """Thresholds at which a robot's rigid bodies match a torque."""

    one: tuple[float, float] = (0.6, 1.7)
    """Factors that count as 1: URDFs have such errors, and lack payloads."""
    right: float = 1.3
    """Max factor of gravity of the right robot."""
    wrong: float = 1.5
    """Min factor of gravity of a wrong robot."""
    explained: float = 0.6
    """Min explained share of a joint's torque for a valid factor."""


MATCH = MatchOptions()


def bodies_of(robot: Profile, names: tuple[str, ...]) -> Bodies | None:
    """Return a robot's rigid bodies for joints of these names, None without a usable URDF that has them all."""
    limits = limits_of(robot, names)
    if limits is None or limits.urdf_joints is None or robot.urdf is None:
        return None
    try:
        return Bodies(robot.urdf, robot.name, names, limits)
    except (MissingExtraError, ValueError):
        return None


def gravity_joints(comparison: Comparison) -> list[int]:
    """Return the joints with a significant part of gravity in their torque."""
    significant = [joint for joint in range(len(comparison.gravity)) if comparison.is_significant(joint, 0)]
    return [joint for joint in significant if comparison.explained[joint] > MATCH.explained]


def median_gravity(comparison: Comparison) -> float | None:
    """Return the median factor of gravity, None if a factor is negative or fewer than two thirds agree."""
    factors = comparison.gravity[gravity_joints(comparison)]
    if not len(factors) or (factors <= 0).any():
        return None
    middle = float(np.median(factors))
    alike = (factors > MATCH.one[0] * middle) & (factors < MATCH.one[1] * middle)
    return middle if 3 * alike.sum() >= 2 * len(factors) else None


def find_candidates(names: tuple[str, ...], signals: Signals) -> tuple[tuple[str, ...], str | None]:
    """Return robots that match the joint names, and the one to compare with: the only one, or the best by gravity."""
    candidates = recognise(names)
    if len(candidates) == 1:
        return candidates, candidates[0]
    off: dict[str, float] = {}
    for candidate in candidates:
        bodies = bodies_of(profile(candidate), names)
        factor = None if bodies is None else median_gravity(compare(bodies, signals))
        if factor is not None and MATCH.one[0] < factor < MATCH.one[1]:
            off[candidate] = abs(np.log(factor))
    return candidates, min(off, key=lambda each: off[each], default=None)


def suggest_robot(upload: Upload, candidates: Sequence[str], best: str | None) -> Remedy | None:
    """Suggest a robot by the joint names, for an upload that names none. best: the robot to compare with."""
    if not candidates:
        return None
    return make_remedy(
        "robot", (), texts.matching_robots(candidates, best), None if best is None else upload.robot(best)
    )


def ask_for_robot(n_joints: int) -> str | None:
    """Return advice to name the robot, None if no known robot has so many joints."""
    known = [each.name for each in profiles() if each.n_joints == n_joints]
    return texts.unknown_robot(known[:3]) if known else None


def find_better_robot(upload: Upload, bodies: Bodies, comparison: Comparison, signals: Signals) -> Remedy | None:
    """Suggest a robot that also matches the joint names and has fitting gravity, unlike the named robot."""
    own = median_gravity(comparison)
    if own is None or 1 / MATCH.wrong < own < MATCH.wrong:
        return None
    _, best = find_candidates(upload.names, signals)
    other = None if best is None or best == bodies.name else bodies_of(profile(best), upload.names)
    if best is None or other is None:
        return None
    fit = compare(other, signals)
    theirs = median_gravity(fit)
    if theirs is None or not 1 / MATCH.right < theirs < MATCH.right or fit.error > comparison.error:
        return None
    return make_remedy("robot", (), texts.better_robot(bodies.name, own, best, theirs), upload.robot(best))
