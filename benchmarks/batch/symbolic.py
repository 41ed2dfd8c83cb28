"""Recursive Newton–Euler of a Pinocchio model as an expression of CasADi, which generates C code from it.

Pinocchio's wheels are built without its own CasADi interface.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lipcore.robots.library import Robot

TINY = 1e-12
"""Rounding errors of placements, such as cos(π/2), count as zero: CasADi then omits their products."""


def rnea_function(casadi: Any, robot: Robot) -> Any:
    """Return the CasADi function (q, dq, ddq) → torques, (n,) each. casadi: the module.

    A link's rates are in its own axes: ω' = Rᵀω + z q̇, p̈' = Rᵀ(p̈ + ω̇ × r + ω × (ω × r)), with the joint's frame R, r.
    """
    model, n = robot.model, robot.n_joints
    q, dq, ddq = (casadi.SX.sym(name, n) for name in ("q", "dq", "ddq"))
    turn, turn_rate, rate = casadi.SX.zeros(3), casadi.SX.zeros(3), -_clean(casadi, model.gravity.linear)
    frames, wrenches = [], []
    for k in range(n):
        joint = model.joints[k + 1]
        kind, place = joint.shortname(), model.jointPlacements[k + 1]
        axis = casadi.SX(np.eye(3)["XYZ".index(kind[-1])])
        fixed, offset = _clean(casadi, place.rotation), _clean(casadi, place.translation)
        slides = kind.startswith("JointModelP")
        if slides:
            rotation, offset = fixed, offset + fixed @ axis * q[k]
        else:
            rotation = fixed @ _turned(casadi, kind[-1], q[k])
        cross, own, own_rate = casadi.cross, axis * dq[k], axis * ddq[k]
        rate = rotation.T @ (rate + cross(turn_rate, offset) + cross(turn, cross(turn, offset)))
        turn, turn_rate = rotation.T @ turn, rotation.T @ turn_rate
        if slides:
            rate += own_rate + 2 * cross(turn, own)
        else:
            turn_rate += own_rate + cross(turn, own)
            turn += own
        body = model.inertias[k + 1]
        centre, inertia = _clean(casadi, body.lever), _clean(casadi, body.inertia)
        force = body.mass * (rate + cross(turn_rate, centre) + cross(turn, cross(turn, centre)))
        moment = inertia @ turn_rate + cross(turn, inertia @ turn) + cross(centre, force)
        frames.append((rotation, offset, axis, slides))
        wrenches.append((force, moment))
    force, moment, torques = casadi.SX.zeros(3), casadi.SX.zeros(3), []
    for k in reversed(range(n)):
        rotation, offset, axis, slides = frames[k]
        force, moment = force + wrenches[k][0], moment + wrenches[k][1]
        torques.append(casadi.dot(axis, force if slides else moment) + float(model.armature[k]) * ddq[k])
        force, moment = rotation @ force, rotation @ moment
        moment += casadi.cross(offset, force)
    return casadi.Function("rnea", [q, dq, ddq], [casadi.vertcat(*reversed(torques))])


def _turned(casadi: Any, axis: str, angle: Any) -> Any:
    """Return the rotation by an angle about the axis X, Y or Z."""
    first = "XYZ".index(axis)
    one, two = (first + 1) % 3, (first + 2) % 3
    rotation, cos, sin = casadi.SX.eye(3), casadi.cos(angle), casadi.sin(angle)
    rotation[one, one] = rotation[two, two] = cos
    rotation[one, two], rotation[two, one] = -sin, sin
    return rotation


def _clean(casadi: Any, values: Any) -> Any:
    return casadi.SX(casadi.sparsify(casadi.DM(np.where(np.abs(values) < TINY, 0.0, values))))
