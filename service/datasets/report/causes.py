"""What ruins a model, and the upload's options that put it right: signs, orders, currents, gravity, negative friction.

Each cause has a sentence only where the evidence is clear, and only the gravest has one: an order of joints that
explains the torque makes all factors of the order that does not meaningless.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lipcore.data.samples import Array
from service.contract.datasets import Cause, JointExcitation, Remedy
from service.datasets.report.advice import listed
from service.datasets.report.bodies import (
    BODIES,
    Against,
    Blocks,
    Bodies,
    Signals,
    design,
    joint_order,
    torque_order,
)
from service.datasets.report.excitation import FRICTION
from service.datasets.report.remedies import Upload, remedy
from service.datasets.report.robots import MATCH, heavy, other_robot


@dataclass(frozen=True)
class CauseOptions:
    """When the evidence for a cause is clear.

    Set on simulated recordings of panda, ur5, z1, kinova, baxter-left, pr2-right, so101 and double-pendulum, clean and
    dirty; tests look at other arms.
    """

    zero: float = 0.35
    """Size below which a factor counts as 0."""
    other: float = 2.0
    """Ratio from which torques that are all too large, or all too small, count as something else."""
    double: tuple[float, float] = (1.6, 2.5)
    """Factors of gravity that count as 2."""
    explained: float = 0.9
    """Share of the torque of joints with visible gravity that is explained if their order is right."""
    absent: float = 2 / 3
    """Share of the joints with visible gravity that have to lack it."""
    stds: float = 3.0
    """Standard deviations by which a factor has to differ."""
    trend: float = 1.0
    """Trend of work over its swing: 0.01 to 0.23 on frictionless arms, 0.7 to 42 on others."""
    gain: float = 3.0
    """Ratio of errors that gravity along another direction has to reach."""


CAUSE = CauseOptions()


BASE = "Give a URDF with the base as it stands, or train with geometry=learn"


@dataclass(frozen=True)
class TorqueWork:
    """Work of all torques on the motion, ∫ Σ tau dq dt: kinetic and potential energy come back, friction's does not.

    power: of its trend, W; trend: how far that goes over the recording, over how far work is from it at most.
    """

    power: float
    trend: float

    @classmethod
    def of(cls, power: Array) -> TorqueWork:
        """Judge Σ tau dq of rows evenly in time, (N,) W."""
        work = np.cumsum(power)
        along = np.linspace(-0.5, 0.5, len(work))
        slope = float(along @ work / (along @ along))
        return cls(slope / len(work), slope / max(float(np.ptp(work - slope * along)), 1e-300))


def causes(
    upload: Upload,
    bodies: Bodies | None,
    against: Against | None,
    signals: Signals,
    friction: Sequence[JointExcitation],
    work: TorqueWork,
) -> list[Remedy]:
    """What is clearly wrong, at most one cause.

    against: the torque compared with that of the bodies; friction: what is known of each joint's; work: of the torques.
    """
    drags = [_drag(each, dq, tau) for each, dq, tau in zip(friction, signals.dq.T, signals.tau.T, strict=True)]
    out = None
    if bodies is not None and against is not None:
        case = _Case(upload, bodies, against, signals, drags)
        out = case.order() or case.sign() or case.gravity() or other_robot(upload, bodies, against, signals)
        out = out or case.factor()
    out = out or _taken(upload, signals, work)
    # friction beside bodies that do not explain the torque is none
    if against is None or (against.explained[against.visible_gravity] > CAUSE.explained).all():
        out = out or _negative_friction(upload, drags)
    return [] if out is None else [out]


def _drag(joint: JointExcitation, dq: Array, tau: Array) -> int:
    """Sign of a joint's friction at its usual speed, 0 where that is not clear; dq, tau: (R,)."""
    viscous, coulomb = joint.viscous, joint.coulomb
    if viscous.value is None or viscous.std is None or coulomb.value is None or coulomb.std is None:
        return 0
    if (viscous.verdict, coulomb.verdict) != ("well", "well"):
        return 0
    speed = float(np.sqrt(np.mean(dq**2)))
    drag, std = viscous.value * speed + coulomb.value, viscous.std * speed + coulomb.std
    clear = abs(drag) > max(FRICTION.negative_stds * std, FRICTION.negative_share * tau.std())
    return int(np.sign(drag)) if clear else 0


def _taken(upload: Upload, signals: Signals, work: TorqueWork) -> Remedy | None:
    """Torques whose work on the motion is negative, which needs no robot to be known."""
    usual = float(np.sqrt(np.mean(signals.dq**2, axis=0)) @ np.sqrt(np.mean(signals.tau**2, axis=0)))
    if work.trend > -CAUSE.trend or work.power > -FRICTION.negative_share * usual:
        return None
    return remedy(
        "torque_sign",
        upload.names,
        f"the torques take {-work.power:.2g} W from the motion in the mean, as if friction drove the arm: is the sign "
        "of all or of some opposite, or were they taken before their motion? If it is the sign of all",
        upload.factors([-1.0] * upload.n_joints),
    )


def _negative_friction(upload: Upload, drags: Sequence[int]) -> Remedy | None:
    who = [name for name, drag in zip(upload.names, drags, strict=True) if drag < 0]
    if not who:
        return None
    return remedy(
        "friction_sign",
        who,
        f"the friction of {listed(who)} is negative: it would drive the joint. Torque of opposite sign has this, "
        "or one taken before its motion, or derivatives that were filtered too much; if it is the sign",
        upload.factors([-1.0 if drag < 0 else 1.0 for drag in drags]),
    )


@dataclass(frozen=True)
class _Case:
    """A recording against the bodies of its robot. drags: signs of the joints' friction, 0 where not clear."""

    upload: Upload
    bodies: Bodies
    against: Against
    signals: Signals
    drags: Sequence[int]

    def order(self) -> Remedy | None:
        """Torques, or joints, in another order."""
        names, robot = self.upload.names, self.bodies.name
        torques = torque_order(self.bodies, self.signals)
        joints = None
        if torques is not None or (self.against.explained[self.against.visible_gravity] < CAUSE.explained).any():
            joints = joint_order(self.bodies, self.signals, self.against)
        if torques is not None and (joints is None or torques.error < joints.error):
            moved = [(names[joint], names[k]) for joint, k in enumerate(torques.column) if k != joint]
            return remedy(
                "torque_order",
                [joint for joint, _ in moved],
                f"torques come in another order than positions, by those that {robot} needs: "
                + listed([f"what is read as that of {k} is that of {joint}" for joint, k in moved]),
                self.upload.torque_columns(torques.column),
            )
        if joints is None:
            return None
        called = [self.bodies.urdf_joints[joint] for joint in np.argsort(joints.column)]
        moved = [
            (name, is_) for name, is_, was in zip(names, called, self.bodies.urdf_joints, strict=True) if is_ != was
        ]
        return remedy(
            "joint_order",
            [name for name, _ in moved],
            f"joints come in another order than those of {robot}, by the torque that it needs: "
            + listed([f"{name} is {is_}" for name, is_ in moved]),
            self.upload.joint_names(called),
        )

    def sign(self) -> Remedy | None:
        """Joints whose torque is opposite by gravity, inertia or friction, and by none of them as it should be."""
        n, against = self.upload.n_joints, self.against
        signs = np.zeros((n, 3), np.int64)
        for j in range(n):
            if against.explained[j] > MATCH.explained:
                signs[j, 0] = np.sign(against.gravity[j]) if against.steady(j, 0) else 0
                signs[j, 1] = np.sign(against.inertia[j]) if against.steady(j, 1) else 0
            signs[j, 2] = self.drags[j]
        opposite = (signs.min(1) < 0) & (signs.max(1) <= 0)
        if not (opposite & (signs[:, :2].min(1) < 0)).any():
            return None
        if opposite[signs[:, 0] != 0].all() and (signs[:, 1:] >= 0).all():
            return None  # gravity alone is opposite: an arm that hangs upside down has that
        if opposite.sum() > 1 and (opposite | (signs == 0).all(1)).all():
            opposite[:] = True  # nothing is known of the others
        who = [name for name, wrong in zip(self.upload.names, opposite, strict=True) if wrong]
        return remedy(
            "torque_sign",
            who,
            f"the torque of {listed(who)} has the opposite sign of what {self.bodies.name} needs",
            self.upload.factors(np.where(opposite, -1.0, 1.0).tolist()),
        )

    def gravity(self) -> Remedy | None:
        """Gravity that is missing, there twice, there though it should not be, or along another direction."""
        g, robot = self.against.gravity, self.bodies.name
        plain, inertia = heavy(self.against), self._inertia()
        if not self.upload.gravity:
            there = plain and all(g[j] - CAUSE.stds * self.against.gravity_std[j] > CAUSE.zero for j in plain)
            if not there or not MATCH.one[0] < float(np.median(g[plain])) < MATCH.one[1]:
                return None
            text = f"holds gravity ({self._times(plain)} times that of {robot}) though it should be without"
            return self._remedy("gravity_included", plain, text, {"torque_convention": "gravity_included"})
        seen = np.flatnonzero(self.against.visible_gravity).tolist()
        expected = [j for j in seen if self.against.gravity_std[j] < CAUSE.zero]
        absent = [j for j in expected if self._absent(j)]
        # where inertia is not as it should be either, all of the torque may be too small
        none = inertia is not None and inertia > 1 / CAUSE.other
        none = none and bool(absent) and len(absent) >= CAUSE.absent * len(expected)
        none = none and float(np.abs(g[expected]).max()) < 1 / CAUSE.other
        turned = bool(plain) and bool((g[plain] < 0).all())
        if seen and (self.against.explained[seen] < CAUSE.explained).any() and self._leans(seen):
            text = f"has gravity along another direction than {robot}'s base: is it on a wall, or tilted? {BASE}"
            return self._remedy("mounting", seen, text)
        if turned:
            text = f"has gravity upwards ({self._times(plain)} times that of {robot}): does it hang upside down? {BASE}"
            return self._remedy("mounting", plain, text)
        if none:
            text = f"is without gravity ({self._times(absent)} times that of {robot})"
            return self._remedy("no_gravity", absent, text, {"torque_convention": "gravity_compensated"})
        if plain and all(CAUSE.double[0] < g[j] < CAUSE.double[1] for j in plain):
            if inertia is not None and not MATCH.one[0] < inertia < MATCH.one[1]:
                return None
            other = "cannot be seen" if inertia is None else f"{inertia:.2g} times"
            text = (
                f"holds gravity twice ({self._times(plain)} times that of {robot}, inertia {other}): something adds it "
                "to a torque that has it already; record that torque without it"
            )
            return self._remedy("gravity_doubled", plain, text)
        return None

    def factor(self) -> Remedy | None:
        """All torques too large or too small by factors, as motor currents are."""
        plain, against = heavy(self.against), self.against
        g = against.gravity[plain]
        if not self.upload.gravity or not plain:
            return None
        if not ((g > CAUSE.other).all() or ((g > 0) & (g < 1 / CAUSE.other)).all()):
            return None
        factors = [
            against.gravity[j] if against.steady(j, 0) else against.inertia[j] if against.steady(j, 1) else np.nan
            for j in range(self.upload.n_joints)
        ]
        known = all(factor > 0 for factor in factors)  # also of those that are no numbers
        text = (
            f"is {self._times(plain)} times what {self.bodies.name} needs: is it motor current, torque before a gear, "
            "in another unit, or that of another robot? If it is current, take the maker's constants, or these"
        )
        return self._remedy(
            "torque_factor", plain, text, self.upload.constants([1 / factor for factor in factors]) if known else None
        )

    def _inertia(self) -> float | None:
        """Usual factor of inertia, None where no joint tells."""
        n = self.upload.n_joints
        known = [self.against.inertia[j] for j in range(n) if self.against.steady(j, 1)]
        return float(np.median(known)) if known else None

    def _absent(self, joint: int) -> bool:
        size = abs(self.against.gravity[joint])
        most = size + CAUSE.stds * self.against.gravity_std[joint]
        return bool(most < CAUSE.zero and size * self.against.visible[joint, 0] < BODIES.visible)

    def _leans(self, joints: Sequence[int]) -> bool:
        """Whether gravity along one other direction explains the torque of these joints far better."""
        gravity, rest = self.bodies.parts(self.signals)
        sides = self.bodies.sideways(self.signals.q)
        gains, directions = [], []
        axes = [0, -2, -1]  # columns of gravity downwards and along two horizontal axes
        for j in joints:
            columns = design(gravity[:, j], rest[:, j], self.signals.dq[:, j])
            both = np.column_stack([columns, sides[0][:, j], sides[1][:, j]])
            upright, leaning = (Blocks.fit(x, self.signals.tau[:, j, None]) for x in (columns, both))
            gains.append(float(np.log(upright.errors.mean()) - np.log(leaning.errors.mean())))
            if (leaning.std[axes] < CAUSE.zero).all():
                directions.append(leaning.weights[axes, 0])
        if len(directions) < 2 or np.mean(gains) < np.log(CAUSE.gain):
            return False
        middle = np.median(directions, axis=0)
        off = np.median(np.abs(directions - middle).max(axis=1))
        return bool(MATCH.one[0] < np.linalg.norm(middle) < MATCH.one[1] and off < CAUSE.zero)

    def _remedy(self, cause: Cause, joints: Sequence[int], text: str, options: dict[str, str] | None = None) -> Remedy:
        names = [self.upload.names[j] for j in joints]
        return remedy(cause, names, f"the torque of {listed(names)} {text}", options)

    def _times(self, joints: Sequence[int]) -> str:
        return listed([f"{self.against.gravity[j]:.2g}" for j in joints])
