"""`mujoco.sysid` on the URDF's arm: `pip install 'mujoco[sysid]'`, version 4.

The arm is a MuJoCo model with the kinematics and the initial masses of the URDF. `mujoco.sysid` minimises the residual
of inverse dynamics over inertias within its default bounds, rotor inertias, viscous and Coulomb friction and offsets.
Coulomb friction is added to MuJoCo's torque, because MuJoCo's own is a constraint.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from io import StringIO
from typing import Any

import numpy as np

from benchmarks.real.peers import Peer
from benchmarks.real.rivals import COULOMB_RAD_S, Forecast, Intervals
from benchmarks.real.splits import thinned
from lipcore.data.samples import Array, Samples
from lipcore.robots.urdf import RigidBody

MAX_ROWS = 500
"""Max training rows; more are thinned evenly, as each step takes one pass a parameter."""
MAX_ITERATIONS = 50
OWN = ("rotor", "viscous", "coulomb", "offset")
"""Parameters of each joint besides its body's inertia."""
MAX_ROTOR = 5.0
"""Bound of a rotor inertia, kg·m²; the bound of friction, at 1 rad/s, and of the offset is a joint's largest torque."""


def is_installed() -> bool:
    """Return whether `mujoco.sysid` and its dependencies are installed."""
    return all(find_spec(name) is not None for name in ("mujoco", "absl", "tabulate"))


def predict_mujoco(body: RigidBody, train: Samples, test: Samples) -> Forecast:
    """Predict torque with the parameters that `mujoco.sysid` finds by inverse dynamics."""
    from mujoco import sysid  # noqa: PLC0415 - not a dependency

    rows, spec = thinned(train, MAX_ROWS), arm(body)
    spread = np.where(train.tau.std(axis=0) > 0, train.tau.std(axis=0), 1.0)

    def residual(x: Array, values: Any) -> tuple[list[Array], None, None]:
        columns = []
        for column in x.reshape(len(x), -1).T:
            values.update_from_vector(column)
            columns.append(((inverse_torque(spec, body, values, rows) - rows.tau) / spread).ravel())
        return [np.array(columns).T if x.ndim > 1 else columns[0]], None, None

    start = start_parameters(spec, np.abs(train.tau).max(axis=0), body)
    found, result = sysid.optimize(start, residual, verbose=False, max_iters=MAX_ITERATIONS, output=StringIO())
    return forecast(spec, body, found, rows, test, count_intervals(residual(result.x, found)[0], result.jac))


def forecast(spec: Any, body: RigidBody, values: Any, rows: Samples, test: Samples, intervals: Intervals) -> Forecast:
    """Return the torque at the states of a test, with the residual of training rows as its standard deviation."""
    mean = inverse_torque(spec, body, values, test)
    std = np.sqrt(np.mean(np.square(inverse_torque(spec, body, values, rows) - rows.tau), axis=0))
    return Forecast(mean, np.broadcast_to(std, mean.shape), intervals)


def inverse_torque(spec: Any, body: RigidBody, values: Any, samples: Samples) -> Array:
    """Return the torque of an arm with the values of `start_parameters` at N samples, (N, n)."""
    import mujoco  # noqa: PLC0415 - not a dependency
    from mujoco import sysid  # noqa: PLC0415 - as above

    model, chain = sysid.apply_param_modifiers(values, spec.copy()), np.argsort(body.order)
    data, found = mujoco.MjData(model), np.empty_like(samples.tau)
    for row, state in enumerate(zip(samples.q, samples.dq, samples.ddq, strict=True)):
        data.qpos[:], data.qvel[:], data.qacc[:] = (each[chain] for each in state)
        mujoco.mj_inverse(model, data)
        found[row, chain] = data.qfrc_inverse
    rotor, viscous, coulomb, offset = (values[name].value for name in OWN)
    sign = np.tanh(samples.dq / COULOMB_RAD_S)
    return np.asarray(found + rotor * samples.ddq + viscous * samples.dq + coulomb * sign + offset)


def count_intervals(residuals: list[Array], jacobian: Array) -> Intervals:
    """Return how many parameters have an interval by `mujoco.sysid`, and how many of these are infinite."""
    from mujoco import sysid  # noqa: PLC0415 - not a dependency

    with np.errstate(all="ignore"):
        _, half = sysid.calculate_intervals([np.ravel(each) for each in residuals], jacobian)
    return Intervals(len(half), int(np.sum(~np.isfinite(half))))


def arm(body: RigidBody) -> Any:
    """Return the URDF's arm as an `MjSpec`, its bodies called body1 to bodyN from base to tip."""
    import mujoco  # noqa: PLC0415 - not a dependency

    spec, model = mujoco.MjSpec(), body.model
    spec.option.gravity = list(model.gravity.linear)
    spec.compiler.balanceinertia = True  # some URDFs have inertias that no body has
    axes, last = model.createData().joints, spec.worldbody
    for index in range(1, model.njoints):
        place, inertia = model.jointPlacements[index], model.inertias[index]
        last = last.add_body(name=f"body{index}", pos=list(place.translation))
        last.quat = _quaternion(mujoco, place.rotation)
        last.explicitinertial, last.mass, last.ipos = True, inertia.mass, list(inertia.lever)
        full = inertia.inertia
        last.fullinertia = [full[0, 0], full[1, 1], full[2, 2], full[0, 1], full[0, 2], full[1, 2]]
        subspace = np.asarray(axes[index].S).ravel()
        slides = np.any(subspace[:3])
        kind = mujoco.mjtJoint.mjJNT_SLIDE if slides else mujoco.mjtJoint.mjJNT_HINGE
        last.add_joint(name=f"joint{index}", type=kind, axis=list(subspace[:3] if slides else subspace[3:]))
    return spec


def _quaternion(mujoco: Any, rotation: Array) -> list[float]:
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(rotation).ravel())
    return list(quaternion)


def inertia_of(sysid: Any, body: str) -> Callable[[Any, Any], None]:
    """Return the function that writes a parameter as the inertia of a body."""

    def apply(spec: Any, parameter: Any) -> None:
        sysid.apply_body_inertia(spec, body, parameter)
        spec.body(body).iquat = [1.0, 0.0, 0.0, 0.0]  # NaN otherwise, which version 4.0.0 cannot compile

    return apply


def start_parameters(spec: Any, largest: Array, body: RigidBody) -> Any:
    """Return the parameters to find and their bounds; joints in the order of the data."""
    from mujoco import sysid  # noqa: PLC0415 - not a dependency

    model, n, found = spec.compile(), body.n_joints, sysid.ParameterDict()
    for index in range(1, n + 1):
        name = f"body{index}"
        kind = sysid.InertiaType.Pseudo
        found.add(sysid.body_inertia_param(spec, model, name, kind, modifier=inertia_of(sysid, name)))
    zero = np.zeros(n)
    starts = (zero + 0.1, 0.05 * largest, 0.05 * largest, zero)
    bounds = ((zero, zero + MAX_ROTOR), (zero, largest), (zero, largest), (-largest, largest))
    for name, start, (low, high) in zip(OWN, starts, bounds, strict=True):
        found.add(sysid.Parameter(name, start, low, high))
    return found


PEER = Peer(
    needs="URDF or MJCF with masses to start from, accelerations, start and bounds of each parameter; SI units",
    friction="viscous, Coulomb (by the user's residual)",
    parameters="95 % intervals",
    torque="none",
    code=(predict_mujoco, inverse_torque, inertia_of, start_parameters),
)
"""Without `arm`: MuJoCo reads most URDFs itself."""
