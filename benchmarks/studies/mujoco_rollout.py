"""Torque that an exported MJCF needs in MuJoCo to follow a recording, compared with the recorded torque.

    python benchmarks/studies/mujoco_rollout.py MODEL_FOLDER RECORDING.npz

A PD controller with gravity compensation moves the arm along the recorded positions. The recording has t, q, dq and
tau, joints in the order of the model. The error is the RMS of the difference divided by the RMS of the recorded torque,
joint by joint, from the first SETTLED_S on. `recorded motion` is the error of `mj_inverse` at the recorded states,
`served` that of the model.
"""

from __future__ import annotations

import sys
from pathlib import Path

import mujoco
import numpy as np
from scipy.interpolate import CubicSpline

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
STIFFNESS_RAD_S, DAMPING = 120.0, 1.0
"""Natural frequency and damping ratio of the controller; its gains follow from the arm's inertia."""


def exported(model: TorqueModel) -> str:
    """Return the MJCF of a model, joints in the order of the chain."""
    parameters = report(model.posterior, model.estimator, model.joint_names)
    return mjcf_text(fit_arm(model, SimulatedArm.of_parameters(parameters, model.joint_names, model.training_range)))


def place_joints(arm: mujoco.MjModel, names: tuple[str, ...]) -> list[int]:
    """Return the place of each joint of the data in MuJoCo's vectors."""
    return [int(arm.joint(name).dofadr[0]) for name in names]


def follow(mjcf: str, names: tuple[str, ...], t: Array, q: Array) -> Array:
    """Return the control torque, (N, n), that moves an arm along positions (N, n) at times (N,)."""
    arm = mujoco.MjModel.from_xml_string(mjcf)
    arm.opt.timestep, arm.jnt_limited[:] = STEP_S, 0
    arm.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    data, place = mujoco.MjData(arm), place_joints(arm, names)
    steps = np.arange(round((t[-1] - t[0]) / STEP_S) + 1) * STEP_S + t[0]
    course = CubicSpline(t, q)  # with a continuous acceleration
    goal, speed = course(steps), course(steps, 1)
    data.qpos[place], data.qvel[place] = goal[0], speed[0]
    used, mass = np.empty_like(goal), np.empty((arm.nv, arm.nv))
    for k in range(len(steps)):
        mujoco.mj_forward(arm, data)
        mujoco.mj_fullM(arm, data, mass)
        wanted = np.zeros(arm.nv)
        error = goal[k] - data.qpos[place], speed[k] - data.qvel[place]
        wanted[place] = STIFFNESS_RAD_S**2 * error[0] + 2 * DAMPING * STIFFNESS_RAD_S * error[1]
        data.ctrl[:] = mass @ wanted + data.qfrc_bias
        used[k] = data.ctrl[place]
        mujoco.mj_step(arm, data)
    return np.stack([np.interp(t, steps, column) for column in used.T], axis=1)


def invert(mjcf: str, names: tuple[str, ...], motion: Array) -> Array:
    """Return the torque of `mj_inverse` with Coulomb friction at N motions (N, 3, n), (N, n)."""
    arm = mujoco.MjModel.from_xml_string(mjcf)
    arm.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS | mujoco.mjtDisableBit.mjDSBL_LIMIT
    data, place, out = mujoco.MjData(arm), place_joints(arm, names), np.empty_like(motion[:, 0])
    for k, (q, dq, ddq) in enumerate(motion):
        data.qpos[place], data.qvel[place], data.qacc[place] = q, dq, ddq
        mujoco.mj_inverse(arm, data)
        out[k] = data.qfrc_inverse[place] + arm.dof_frictionloss[place] * np.sign(dq)
    return out


def relative_error(tau: Array, recorded: Array) -> Array:
    """Return the RMS of the difference over the RMS of the recorded torque, (n,)."""
    return np.asarray(np.sqrt(np.mean((tau - recorded) ** 2, axis=0) / np.mean(recorded**2, axis=0)))


def main() -> None:
    """Print a Markdown table of errors, joint by joint."""
    model, recording = lipcore.load(sys.argv[1]), np.load(Path(sys.argv[2]))
    t, q, dq, tau = (np.asarray(recording[name], np.float64) for name in ("t", "q", "dq", "tau"))
    ddq = recording["ddq"] if "ddq" in recording else np.gradient(dq, t, axis=0)
    mjcf, names = exported(model), model.joint_names
    columns = {
        "followed": follow(mjcf, names, t, q),
        "recorded motion": invert(mjcf, names, np.stack([q, dq, ddq], axis=1)),
        "served": model.predict(q, dq, ddq).tau,
    }
    settled = t > t[0] + SETTLED_S
    print("| joint | " + " | ".join(columns) + " |\n| " + "--- | " * (1 + len(columns)))
    for joint, name in enumerate(names):
        errors = (relative_error(values[settled], tau[settled])[joint] for values in columns.values())
        print(f"| {name} | " + " | ".join(f"{error:.1%}" for error in errors) + " |")
    distance = np.abs(columns["recorded motion"] - columns["served"]).max(axis=0)
    print("largest distance of the file from the served answer, N·m (N):", *(f"{each:.3g}" for each in distance))


if __name__ == "__main__":
    main()
