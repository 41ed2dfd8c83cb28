"""Which robot a recording is of: by the names of its joints, and by the torque that gravity asks of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lipcore.extras import MissingExtraError
from lipcore.profiles import Profile, profile, profiles, recognise
from service.contract.datasets import Remedy
from service.datasets.report.advice import listed
from service.datasets.report.bodies import Against, Bodies, Signals, compare
from service.datasets.report.remedies import Upload, remedy
from service.datasets.report.signals import limits_of


@dataclass(frozen=True)
class MatchOptions:
    """When a robot's rigid bodies explain a torque."""

    one: tuple[float, float] = (0.6, 1.7)
    """Factors that count as 1: URDFs are wrong by as much, and payloads are not in them."""
    right: float = 1.3
    """Max factor of gravity of the right robot."""
    wrong: float = 1.5
    """Min factor of gravity of a wrong robot."""
    explained: float = 0.6
    """Share of a joint's torque that has to be explained before a factor is believed."""


MATCH = MatchOptions()


def bodies_of(robot: Profile, names: tuple[str, ...]) -> Bodies | None:
    """A robot's rigid bodies for joints of these names; None without a URDF that can be used for all of them."""
    limits = limits_of(robot, names)
    if limits is None or limits.urdf_joints is None or robot.urdf is None:
        return None
    try:
        return Bodies(robot.urdf, robot.name, names, limits)
    except (MissingExtraError, ValueError):
        return None


def heavy(against: Against) -> list[int]:
    """Joints whose torque gravity is a visible and steady part of."""
    return [j for j in range(len(against.gravity)) if against.steady(j, 0) and against.explained[j] > MATCH.explained]


def usual_gravity(against: Against) -> float | None:
    """Median of the joints' factors of gravity, where most that tell agree with it and all have the right sign."""
    factors = against.gravity[heavy(against)]
    if not len(factors) or (factors <= 0).any():
        return None
    middle = float(np.median(factors))
    alike = (factors > MATCH.one[0] * middle) & (factors < MATCH.one[1] * middle)
    return middle if 3 * alike.sum() >= 2 * len(factors) else None


def proposed(names: tuple[str, ...], signals: Signals) -> tuple[tuple[str, ...], str | None]:
    """Robots that the joints' names suggest, and the one to compare with: the only one, or whose gravity fits."""
    candidates = recognise(names)
    if len(candidates) == 1:
        return candidates, candidates[0]
    off: dict[str, float] = {}
    for candidate in candidates:
        bodies = bodies_of(profile(candidate), names)
        usual = None if bodies is None else usual_gravity(compare(bodies, signals))
        if usual is not None and MATCH.one[0] < usual < MATCH.one[1]:
            off[candidate] = abs(np.log(usual))
    return candidates, min(off, key=lambda each: off[each], default=None)


def suggestion(upload: Upload, candidates: Sequence[str], best: str | None) -> Remedy | None:
    """The robot that names of joints suggest, where the upload names none; best: the one to compare with."""
    if not candidates:
        return None
    text = f"the joints are called as those of {listed(candidates)}"
    if best is None:
        return remedy("robot", (), f"{text}: name the robot with `--robot`")
    if len(candidates) > 1:
        text += f", and the torque is that of {best}"
    return remedy("robot", (), f"{text}; limits and torque can be compared with its", upload.robot(best))


def unnamed(n_joints: int) -> str | None:
    """What to add where neither the upload nor its joints' names tell a robot; None where none of so many is known."""
    known = [each.name for each in profiles() if each.n_joints == n_joints]
    if not known:
        return None
    return (
        "no robot is named, and the names of the joints suggest none: is it one of `lipserve robots list`, such as "
        f"{listed(known[:3])}? Then upload it with `--robot`, and friction, limits and torque are judged "
        "beside its own"
    )


def other_robot(upload: Upload, bodies: Bodies, against: Against, signals: Signals) -> Remedy | None:
    """A robot whose joints are called alike and whose gravity is that of the torque, where the upload's is not."""
    own = usual_gravity(against)
    if own is None or 1 / MATCH.wrong < own < MATCH.wrong:
        return None
    _, best = proposed(upload.names, signals)
    other = None if best is None or best == bodies.name else bodies_of(profile(best), upload.names)
    if best is None or other is None:
        return None
    fit = compare(other, signals)
    theirs = usual_gravity(fit)
    if theirs is None or not 1 / MATCH.right < theirs < MATCH.right or fit.error > against.error:
        return None
    return remedy(
        "robot",
        (),
        f"gravity in the torque is {own:.2g} times that of {bodies.name}, but {theirs:.2g} times that of {best}, whose "
        "joints are called alike",
        upload.robot(best),
    )
