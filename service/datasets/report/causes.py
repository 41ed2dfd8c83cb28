"""Faults that would spoil a model, and the upload options that correct them.

Faults are wrong signs, orders, currents or gravity, and negative friction. Only the gravest fault with clear evidence
is reported: if another order of the joints explains the torque, factors in the present order mean nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lipcore.data.samples import Array
from lipcore.data.signals import noise_level
from service.contract.datasets import JointExcitation, Remedy
from service.datasets.report import fault_texts
from service.datasets.report.bodies import (
    BODIES,
    BlockFit,
    Bodies,
    Comparison,
    Signals,
    design_matrix,
    find_joint_order,
    find_torque_order,
)
from service.datasets.report.excitation import FRICTION
from service.datasets.report.remedies import Upload, make_remedy
from service.datasets.report.robots import MATCH, find_better_robot, gravity_joints


@dataclass(frozen=True)
class CauseOptions:
    """Thresholds of clear evidence.

    Tuned on simulated recordings of panda, ur5, z1, kinova, baxter-left, pr2-right, so101 and double-pendulum, clean
    and dirty. Tests use other arms.
    """

    zero: float = 0.35
    """Size below which a factor counts as 0."""
    visible: float = 0.05
    """Share of a torque's standard deviation above which gravity would show, even in narrow motion."""
    scale: float = 2.0
    """Ratio above which torques that are all too large, or all too small, are not torques of the robot in N·m."""
    double: tuple[float, float] = (1.6, 2.5)
    """Factors of gravity that count as 2."""
    explained: float = 0.9
    """Min explained share of the torque of joints with visible gravity if their order is right."""
    min_absent: float = 2 / 3
    """Min share of the joints with visible gravity that lack it."""
    stds: float = 3.0
    """Standard deviations by which a factor has to differ."""
    trend: float = 1.0
    """Trend of work over its swing: 0.01 to 0.23 on frictionless arms, 0.7 to 42 on others."""
    min_gain: float = 3.0
    """Min ratio of errors for gravity in another direction."""


CAUSE = CauseOptions()


@dataclass(frozen=True)
class TorqueWork:
    """Work of all torques on the motion, ∫ Σ tau dq dt.

    Kinetic and potential energy return; energy lost to friction does not, so that work has a trend.

    power: slope of the trend, W; trend: rise of the trend over the recording, divided by the span of work around it;
    std: standard error of the power by white noise, W.
    """

    power: float
    trend: float
    std: float

    @classmethod
    def of(cls, power: Array) -> TorqueWork:
        """Integrate Σ tau dq of evenly spaced rows, (N,) W, and fit the trend."""
        work = np.cumsum(power)
        along = np.linspace(-0.5, 0.5, len(work))
        slope = float(along @ work / (along @ along))
        trend = slope / max(float(np.ptp(work - slope * along)), 1e-300)
        return cls(slope / len(work), trend, float(noise_level([power[:, None]])[0]) / np.sqrt(len(power)))


def find_faults(
    upload: Upload,
    bodies: Bodies | None,
    comparison: Comparison | None,
    signals: Signals,
    friction: Sequence[JointExcitation],
    work: TorqueWork,
) -> list[Remedy]:
    """Return the gravest fault with clear evidence, if any.

    comparison: torque compared with that of the bodies; friction: of each joint; work: of the torques.
    """
    signs = [_friction_sign(each, dq, tau) for each, dq, tau in zip(friction, signals.dq.T, signals.tau.T, strict=True)]
    out = None
    if bodies is not None and comparison is not None:
        case = _Case(upload, bodies, comparison, signals, signs)
        out = case.check_order() or case.check_sign() or case.check_gravity()
        out = out or find_better_robot(upload, bodies, comparison, signals) or case.check_scale()
    out = out or _check_work(upload, signals, work)
    # friction estimates are meaningless if the bodies do not explain the torque
    if comparison is None or (comparison.explained[comparison.visible_gravity] > CAUSE.explained).all():
        out = out or _check_friction(upload, signs)
    return [] if out is None else [out]


def _friction_sign(joint: JointExcitation, dq: Array, tau: Array) -> int:
    """Return the sign of a joint's friction at its root-mean-square speed, 0 if it is not clear; dq, tau: (R,)."""
    viscous, coulomb = joint.viscous, joint.coulomb
    if viscous.value is None or viscous.std is None or coulomb.value is None or coulomb.std is None:
        return 0
    if (viscous.verdict, coulomb.verdict) != ("well", "well"):
        return 0
    speed = float(np.sqrt(np.mean(dq**2)))
    friction, std = viscous.value * speed + coulomb.value, viscous.std * speed + coulomb.std
    clear = abs(friction) > max(FRICTION.negative_stds * std, FRICTION.negative_share * tau.std())
    return int(np.sign(friction)) if clear else 0


def _check_work(upload: Upload, signals: Signals, work: TorqueWork) -> Remedy | None:
    """Report torques that do negative work on the motion. This needs no robot."""
    usual = float(np.sqrt(np.mean(signals.dq**2, axis=0)) @ np.sqrt(np.mean(signals.tau**2, axis=0)))
    least = max(FRICTION.negative_share * usual, CAUSE.stds * work.std)
    if work.trend > -CAUSE.trend or work.power > -least:
        return None
    return make_remedy(
        "torque_sign",
        upload.names,
        fault_texts.energy_loss(-work.power),
        upload.scaled_torque([-1.0] * upload.n_joints),
        only_if="all signs are inverted",
    )


def _check_friction(upload: Upload, signs: Sequence[int]) -> Remedy | None:
    negative = [name for name, sign in zip(upload.names, signs, strict=True) if sign < 0]
    if not negative:
        return None
    return make_remedy(
        "friction_sign",
        negative,
        fault_texts.negative_friction(negative),
        upload.scaled_torque([-1.0 if sign < 0 else 1.0 for sign in signs]),
        only_if="the sign is inverted",
    )


@dataclass(frozen=True)
class _Case:
    """A recording and the bodies of its robot. friction_signs: of each joint, 0 if not clear."""

    upload: Upload
    bodies: Bodies
    comparison: Comparison
    signals: Signals
    friction_signs: Sequence[int]

    def check_order(self) -> Remedy | None:
        """Report torques, or joints, in another order."""
        names, robot = self.upload.names, self.bodies.name
        torques = find_torque_order(self.bodies, self.signals)
        joints = None
        if torques is not None or (self.comparison.explained[self.comparison.visible_gravity] < CAUSE.explained).any():
            joints = find_joint_order(self.bodies, self.signals, self.comparison)
        if torques is not None and (joints is None or torques.error < joints.error):
            moved = [(names[joint], names[k]) for joint, k in enumerate(torques.column) if k != joint]
            return make_remedy(
                "torque_order",
                [joint for joint, _ in moved],
                fault_texts.torque_order(robot, moved),
                self.upload.torque_columns(torques.column),
            )
        if joints is None:
            return None
        actual = [self.bodies.urdf_joints[joint] for joint in np.argsort(joints.column)]
        moved = [
            (name, new) for name, new, old in zip(names, actual, self.bodies.urdf_joints, strict=True) if new != old
        ]
        return make_remedy(
            "joint_order",
            [name for name, _ in moved],
            fault_texts.joint_order(robot, moved),
            self.upload.joint_names(actual),
        )

    def check_sign(self) -> Remedy | None:
        """Report joints with gravity, inertia or friction of the opposite sign, and none of them the right one."""
        n, comparison = self.upload.n_joints, self.comparison
        signs = np.zeros((n, 3), np.int64)
        for j in range(n):
            if comparison.explained[j] > MATCH.explained:
                signs[j, 0] = np.sign(comparison.gravity[j]) if comparison.is_significant(j, 0) else 0
                signs[j, 1] = np.sign(comparison.inertia[j]) if comparison.is_significant(j, 1) else 0
            signs[j, 2] = self.friction_signs[j]
        opposite = (signs.min(1) < 0) & (signs.max(1) <= 0)
        if not (opposite & (signs[:, :2].min(1) < 0)).any():
            return None
        if opposite[signs[:, 0] != 0].all() and (signs[:, 1:] >= 0).all():
            return None  # only gravity has the opposite sign: the arm hangs upside down
        if opposite.sum() > 1 and (opposite | (signs == 0).all(1)).all():
            opposite[:] = True  # the other joints show no sign
        inverted = [name for name, wrong in zip(self.upload.names, opposite, strict=True) if wrong]
        return make_remedy(
            "torque_sign",
            inverted,
            fault_texts.opposite_sign(inverted, self.bodies.name),
            self.upload.scaled_torque(np.where(opposite, -1.0, 1.0).tolist()),
        )

    def check_gravity(self) -> Remedy | None:
        """Report gravity that is missing, doubled, unexpected or in another direction."""
        g, robot, comparison = self.comparison.gravity, self.bodies.name, self.comparison
        heavy, inertia = gravity_joints(comparison), self._median_inertia()
        if not self.upload.gravity:
            clear = heavy and all(g[j] - CAUSE.stds * comparison.gravity_std[j] > CAUSE.zero for j in heavy)
            if not clear or not MATCH.one[0] < float(np.median(g[heavy])) < MATCH.one[1]:
                return None
            names, options = self._names(heavy), {"torque_convention": "gravity_included"}
            return make_remedy(
                "gravity_included", names, fault_texts.unexpected_gravity(names, g[heavy], robot), options
            )
        known = (comparison.visible[:, 0] > CAUSE.visible) & (comparison.gravity_std < CAUSE.zero)
        expected = np.flatnonzero(known).tolist()
        absent = [j for j in expected if self._lacks_gravity(j)]
        # if inertia is too small as well, all of the torque may be too small
        missing = inertia is not None and inertia > 1 / CAUSE.scale
        missing = missing and bool(absent) and len(absent) >= CAUSE.min_absent * len(expected)
        missing = missing and float(np.abs(g[expected]).max()) < 1 / CAUSE.scale
        upwards = bool(heavy) and bool((g[heavy] < 0).all())
        if (comparison.explained < CAUSE.explained).any() and (tilt := self._find_tilt()) is not None:
            names = self._names(tilt[0])
            return make_remedy("mounting", names, fault_texts.tilted_gravity(names, robot, tilt[1]))
        names = self._names(heavy)
        if upwards:
            return make_remedy("mounting", names, fault_texts.upward_gravity(names, g[heavy], robot))
        if missing:
            names, options = self._names(absent), {"torque_convention": "gravity_compensated"}
            return make_remedy("no_gravity", names, fault_texts.missing_gravity(names, g[absent], robot), options)
        if heavy and all(CAUSE.double[0] < g[j] < CAUSE.double[1] for j in heavy):
            if inertia is not None and not MATCH.one[0] < inertia < MATCH.one[1]:
                return None
            return make_remedy("gravity_doubled", names, fault_texts.doubled_gravity(names, g[heavy], robot, inertia))
        return None

    def check_scale(self) -> Remedy | None:
        """Report torques that are all too large or too small, as motor currents are."""
        heavy, comparison = gravity_joints(self.comparison), self.comparison
        g = comparison.gravity[heavy]
        if not self.upload.gravity or not heavy:
            return None
        if not ((g > CAUSE.scale).all() or ((g > 0) & (g < 1 / CAUSE.scale)).all()):
            return None
        factors = [
            comparison.gravity[j]
            if comparison.is_significant(j, 0)
            else comparison.inertia[j]
            if comparison.is_significant(j, 1)
            else np.nan
            for j in range(self.upload.n_joints)
        ]
        known = all(factor > 0 for factor in factors)  # False for NaN as well
        names = self._names(heavy)
        return make_remedy(
            "torque_factor",
            names,
            fault_texts.torque_scale(names, g, self.bodies.name),
            self.upload.torque_constants([1 / factor for factor in factors]) if known else None,
            only_if="these are unknown",
        )

    def _median_inertia(self) -> float | None:
        """Return the median factor of inertia, None if no joint determines one."""
        n = self.upload.n_joints
        known = [self.comparison.inertia[j] for j in range(n) if self.comparison.is_significant(j, 1)]
        return float(np.median(known)) if known else None

    def _lacks_gravity(self, joint: int) -> bool:
        size = abs(self.comparison.gravity[joint])
        upper = size + CAUSE.stds * self.comparison.gravity_std[joint]
        return bool(upper < CAUSE.zero and size * self.comparison.visible[joint, 0] < BODIES.visible)

    def _find_tilt(self) -> tuple[list[int], float] | None:
        """Return the joints that show gravity in another direction, and the angle to it in degrees; None if none do.

        One direction is fitted to all joints: each torque, without its own inertia and friction, as a combination of
        those by gravity downwards and along two horizontal axes.
        """
        gravity, rest = self.bodies.parts(self.signals)
        sides = np.stack([gravity, *self.bodies.horizontal_gravity(self.signals.q)], axis=-1)
        torque, own = np.empty_like(self.signals.tau), np.empty_like(sides)
        for j in range(self.upload.n_joints):
            basis = np.linalg.qr(design_matrix(gravity[:, j], rest[:, j], self.signals.dq[:, j])[:, 1:])[0]
            spread = max(float(self.signals.tau[:, j].std()), 1e-12)
            for parts, out in ((self.signals.tau[:, j, None], torque[:, j, None]), (sides[:, j], own[:, j])):
                out[:] = (parts - basis @ (basis.T @ parts)) / spread
        rows, values = own.reshape(-1, 3), torque.reshape(-1, 1)
        upright, tilted = (BlockFit.of(rows[:, :count], values) for count in (1, 3))
        gain, found = upright.errors.mean() / tilted.errors.mean(), tilted.weights[:, 0]
        size = float(np.linalg.norm(found))
        if gain < CAUSE.min_gain or not MATCH.one[0] < size < MATCH.one[1] or (tilted.std > CAUSE.zero).any():
            return None
        joints = np.flatnonzero((own @ found).std(axis=0) > BODIES.visible)
        return joints.tolist(), float(np.degrees(np.arccos(np.clip(found[0] / size, -1.0, 1.0))))

    def _names(self, joints: Sequence[int]) -> list[str]:
        return [self.upload.names[j] for j in joints]
