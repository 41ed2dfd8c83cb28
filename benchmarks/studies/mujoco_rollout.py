"""Torque that an exported MJCF needs in MuJoCo to follow a recording, compared with the recorded torque.

    python benchmarks/studies/mujoco_rollout.py MODEL_FOLDER RECORDING.npz [--mjcf ARM.xml]

A PD controller with gravity compensation moves the arm along the recording: t, q, dq, ddq and tau, joints in the order
of the model. The error is the RMS of the difference divided by the RMS of the recorded torque, joint by joint, from the
first SETTLED_S on. Columns:

- `followed`: torque of the controller in MuJoCo.
- `inverse`: `mj_inverse` at the recorded states.
- `without offset`: the same without the offset of the motors.
- `served`: the model at the recorded states, the bound of what an export of it can reach.
- `--mjcf`: another arm, such as panda_nohand.xml of mujoco_menagerie, followed and inverse. Its meshes are not needed.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
from scipy.interpolate import CubicHermiteSpline

import lipcore
from lipcore.data.samples import Array
from lipcore.export.fitted_arm import fit_arm
from lipcore.export.mjcf_writer import mjcf_text
from lipcore.export.simulated_arm import SimulatedArm
from lipcore.model.parameters import report
from lipcore.model.torque_model import TorqueModel

STEP_S = 5e-4
SETTLED_S = 0.2
"""Time after which the controller has settled."""
STIFFNESS_RAD_S, DAMPING = 600.0, 1.0
"""Natural frequency and damping ratio of the controller; its gains follow from the arm's inertia. With 120 rad/s, the
last joint of a Panda, with 0.001 kg·m² and friction of 0.25 N·m, stays behind whenever it turns back."""
DRIFT_DEGREE = 3
"""Degree of the polynomial of time that corrects the drift of integrated velocities."""


def exported(model: TorqueModel) -> str:
    """Return the MJCF of a model, joints in the order of the chain."""
    parameters = report(model.posterior, model.estimator, model.joint_names)
    return mjcf_text(fit_arm(model, SimulatedArm.of_parameters(parameters, model.joint_names, model.training_range)))


def open_arm(mjcf: str, n_joints: int) -> mujoco.MjModel:
    """Return an arm without geometry, servos and joint limits; its first joints are those of the recording.

    Raise ValueError for an arm with fewer joints. Further joints, such as those of fingers, are fixed.
    """
    spec = mujoco.MjSpec.from_string(mjcf)
    servos = [motor for motor in spec.actuators if motor.gainprm[0] != 1.0]
    drawn = (*spec.geoms, *spec.meshes, *spec.keys)
    for each in (*drawn, *servos, *spec.tendons, *spec.equalities, *spec.excludes, *spec.joints[n_joints:]):
        spec.delete(each)
    arm = spec.compile()
    if arm.nv < n_joints:
        raise ValueError(f"The arm has {arm.nv} joints; the recording has {n_joints}.")
    arm.jnt_limited[:] = 0
    arm.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    return arm


def place_joints(arm: mujoco.MjModel, names: tuple[str, ...]) -> list[int]:
    """Return the place of each joint of the data in MuJoCo's vectors; if an arm has other names, base to tip."""
    own = [arm.joint(k).name for k in range(arm.njnt)]
    return [own.index(name) for name in names] if set(names) <= set(own) else list(range(len(names)))


def motor_offset(arm: mujoco.MjModel) -> Array:
    """Return the offset of the torque, which exported motors have as their bias, (n,)."""
    offset = np.zeros(arm.nv)
    for k in range(arm.nu):
        offset[arm.jnt_dofadr[arm.actuator_trnid[k, 0]]] = -arm.actuator_biasprm[k, 0]
    return offset


def course_of(t: Array, motion: Array) -> Callable[[Array], tuple[Array, Array]]:
    """Return a function of time that gives positions and velocities, (M, n) each, along N motions (N, 3, n).

    Velocities pass through the recorded ones with the recorded accelerations; positions are their integral, because
    the second derivative of recorded positions is noise.
    """
    q, dq, ddq = motion.swapaxes(0, 1)
    velocity = CubicHermiteSpline(t, dq, ddq)
    position = velocity.antiderivative()
    powers = np.vander(t - t.mean(), DRIFT_DEGREE + 1)
    drift = np.linalg.lstsq(powers, q - position(t))[0]

    def course(at: Array) -> tuple[Array, Array]:
        return position(at) + np.vander(at - t.mean(), DRIFT_DEGREE + 1) @ drift, velocity(at)

    return course


def follow(mjcf: str, names: tuple[str, ...], t: Array, motion: Array) -> Array:
    """Return the control torque, (N, n), that moves an arm along motions (N, 3, n) at times (N,)."""
    arm = open_arm(mjcf, len(names))
    arm.opt.timestep, arm.opt.integrator = STEP_S, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    data, place = mujoco.MjData(arm), place_joints(arm, names)
    steps = np.arange(round((t[-1] - t[0]) / STEP_S) + 1) * STEP_S + t[0]
    goal, speed = course_of(t, motion)(steps)
    data.qpos[place], data.qvel[place] = goal[0], speed[0]
    used, mass = np.empty_like(goal), np.empty((arm.nv, arm.nv))
    for k in range(len(steps)):
        mujoco.mj_forward(arm, data)
        mujoco.mj_fullM(arm, data, mass)
        wanted = np.zeros(arm.nv)
        error = goal[k] - data.qpos[place], speed[k] - data.qvel[place]
        wanted[place] = STIFFNESS_RAD_S**2 * error[0] + 2 * DAMPING * STIFFNESS_RAD_S * error[1]
        data.qfrc_applied[:] = mass @ wanted + data.qfrc_bias
        used[k] = data.qfrc_applied[place]
        mujoco.mj_step(arm, data)
    torque = np.stack([np.interp(t, steps, column) for column in used.T], axis=1)
    return torque + motor_offset(arm)[place]


def invert(mjcf: str, names: tuple[str, ...], motion: Array) -> Array:
    """Return the torque of `mj_inverse` with Coulomb friction and offset at N motions (N, 3, n), (N, n)."""
    arm = open_arm(mjcf, len(names))
    arm.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
    data, place, out = mujoco.MjData(arm), place_joints(arm, names), np.empty_like(motion[:, 0])
    for k, (q, dq, ddq) in enumerate(motion):
        data.qpos[place], data.qvel[place], data.qacc[place] = q, dq, ddq
        mujoco.mj_inverse(arm, data)
        out[k] = data.qfrc_inverse[place] + arm.dof_frictionloss[place] * np.sign(dq)
    return out + motor_offset(arm)[place]


def relative_error(tau: Array, recorded: Array) -> Array:
    """Return the RMS of the difference over the RMS of the recorded torque, (n,)."""
    return np.asarray(np.sqrt(np.mean((tau - recorded) ** 2, axis=0) / np.mean(recorded**2, axis=0)))


def main() -> None:
    """Print a Markdown table of errors, joint by joint."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, help="folder of the model")
    parser.add_argument("recording", type=Path, help="recording with t, q, dq, ddq and tau")
    parser.add_argument("--mjcf", type=Path, help="another arm to compare with")
    options = parser.parse_args()
    model, recording = lipcore.load(options.model), np.load(options.recording)
    t, q, dq, ddq, tau = (np.asarray(recording[name], np.float64) for name in ("t", "q", "dq", "ddq", "tau"))
    mjcf, names, motion = exported(model), model.joint_names, np.stack([q, dq, ddq], axis=1)
    arm = open_arm(mjcf, len(names))
    inverse, served = invert(mjcf, names, motion), model.predict(q, dq, ddq).tau
    columns = {
        "followed": follow(mjcf, names, t, motion),
        "inverse": inverse,
        "without offset": inverse - motor_offset(arm)[place_joints(arm, names)],
        "served": served,
    }
    if options.mjcf is not None:
        other = options.mjcf.read_text()
        columns[f"{options.mjcf.stem}, followed"] = follow(other, names, t, motion)
        columns[f"{options.mjcf.stem}, inverse"] = invert(other, names, motion)
    settled = t > t[0] + SETTLED_S
    print("| joint | torque RMS, N·m (N) | " + " | ".join(columns) + " |\n| " + "--- | " * (2 + len(columns)))
    errors = {column: relative_error(values[settled], tau[settled]) for column, values in columns.items()}
    for joint, name in enumerate(names):
        usual = np.sqrt(np.mean(tau[settled, joint] ** 2))
        print(f"| {name} | {usual:.2f} | " + " | ".join(f"{each[joint]:.1%}" for each in errors.values()) + " |")
    distance = np.abs(inverse - served).max(axis=0)
    print("largest distance of the file from the served answer, N·m (N):", *(f"{each:.3g}" for each in distance))


if __name__ == "__main__":
    main()
