"""`mujoco.sysid` as its makers use it: the residual of simulated motion, `pip install 'mujoco[sysid]'`, version 4.

The arm of `mujoco_sysid` starts in the recorded state and is driven by the recorded torque for WINDOW_S, again and
again. `mujoco.sysid` minimises the difference of simulated and recorded positions and velocities. Rotor, viscous and
Coulomb friction are MuJoCo's armature, damping and frictionloss; the offset is a bias of the motor.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from io import StringIO
from typing import Any

import numpy as np

from benchmarks.real.mujoco_sysid import (
    MAX_ROWS,
    OWN,
    arm,
    count_intervals,
    forecast,
    inertia_of,
    start_parameters,
)
from benchmarks.real.peers import Peer
from benchmarks.real.rivals import Forecast
from benchmarks.real.splits import thinned
from lipcore.data.samples import Array, Samples
from lipcore.robots.urdf import RigidBody

WINDOW_S = 0.1
MAX_WINDOWS = 20
"""Max windows; more are thinned evenly, as each step of the optimiser simulates all of them once a parameter."""
MAX_ITERATIONS = 20
"""Max steps of the optimiser; each takes seconds with seven joints."""
STEP_S = 2e-3
"""Time step of the simulation: MuJoCo's default."""


def predict_forward(body: RigidBody, train: Samples, test: Samples) -> Forecast:
    """Predict torque with the parameters that `mujoco.sysid` finds by simulated motion."""
    from mujoco import sysid  # noqa: PLC0415 - not a dependency

    spec, chain = driven(arm(body)), np.argsort(body.order)
    model, windows = spec.compile(), list(_windows(train))
    steps = np.linspace(0.0, WINDOW_S, round(WINDOW_S / STEP_S) + 1)
    starts, controls, measured = [], [], []
    for t, q, dq, tau in windows:
        motion = [_interpolated(steps, t, each[:, chain]) for each in (q, dq, tau)]
        starts.append(sysid.create_initial_state(model, motion[0][0], motion[1][0]))
        measured.append(sysid.TimeSeries.from_names(steps, np.concatenate(motion[:2], axis=1), model))
        controls.append(sysid.TimeSeries(steps, motion[2]))
    scale = np.concatenate([train.q.std(axis=0)[chain], train.dq.std(axis=0)[chain]])
    scale[scale == 0] = 1.0

    values = start_parameters(spec, np.abs(train.tau).max(axis=0), body)

    @lru_cache(maxsize=int(values.size) + 1)  # each window asks for the same models
    def compiled(vector: bytes) -> Any:
        values.update_from_vector(np.frombuffer(vector))
        changed = sysid.apply_param_modifiers_spec(values, spec.copy())
        for place, joint in enumerate(chain):
            of_joint, motor = changed.joint(f"joint{place + 1}"), changed.actuator(f"motor{place + 1}")
            of_joint.armature, viscous, of_joint.frictionloss, offset = (values[name].value[joint] for name in OWN)
            of_joint.damping[0], motor.biasprm[0] = viscous, -offset
        return changed.compile()

    def build(values: Any, _spec: Any) -> Any:
        return compiled(values.as_vector().tobytes())

    def scaled(_values: Any, simulated: Any, recorded: Any, *_: Any, **__: Any) -> tuple[Array, Any, Any]:
        return (simulated.data - recorded.data[1:]) / scale, simulated, recorded

    names = [f"window{number}" for number in range(len(windows))]
    residual = sysid.build_residual_fn(
        models_sequences=[sysid.ModelSequences("arm", spec, names, starts, controls, measured)],
        build_model=build,
        modify_residual=scaled,
        resample_true=False,
    )
    found, result = sysid.optimize(values, residual, verbose=False, max_iters=MAX_ITERATIONS, output=StringIO())
    intervals = count_intervals(residual(result.x, found)[0], result.jac)
    return forecast(spec, body, found, thinned(train, MAX_ROWS), test, intervals)


def driven(spec: Any) -> Any:
    """Add a motor and sensors of position and velocity to each joint of an arm, and the time step."""
    import mujoco  # noqa: PLC0415 - not a dependency

    spec.option.timestep, spec.option.integrator = STEP_S, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    joints, kind = [joint.name for joint in spec.joints], mujoco.mjtObj.mjOBJ_JOINT
    for sensor in (mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtSensor.mjSENS_JOINTVEL):
        for joint in joints:
            spec.add_sensor(name=f"{joint}_{int(sensor)}", type=sensor, objtype=kind, objname=joint)
    for joint in joints:
        motor = spec.add_actuator(name=joint.replace("joint", "motor"), target=joint)
        motor.trntype, motor.biastype = mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtBias.mjBIAS_AFFINE
    return spec


def _windows(samples: Samples) -> Iterator[tuple[Array, Array, Array, Array]]:
    """Yield t, q, dq and tau of windows of at least WINDOW_S, t from zero on."""
    found = []
    for part in samples.episodes():
        episode = samples.rows(part)
        at = episode.t - episode.t[0]
        starts = np.searchsorted(at, np.arange(0.0, at[-1] - WINDOW_S, WINDOW_S))
        found += [(episode, first, np.searchsorted(at, at[first] + WINDOW_S) + 1) for first in starts]
    for number in np.unique(np.linspace(0, len(found) - 1, min(len(found), MAX_WINDOWS)).round().astype(np.int64)):
        episode, *ends = found[number]
        rows = episode.rows(slice(*ends))
        yield rows.t - rows.t[0], rows.q, rows.dq, rows.tau


def _interpolated(at: Array, t: Array, values: Array) -> Array:
    return np.stack([np.interp(at, t, column) for column in values.T], axis=1)


PEER = Peer(
    needs="URDF or MJCF with masses to start from, start and bounds of each parameter, motors, sensors, time step and "
    "length of windows; SI units",
    friction="viscous, Coulomb",
    parameters="95 % intervals",
    torque="none",
    code=(predict_forward, driven, _windows, _interpolated, inertia_of, start_parameters),
)
