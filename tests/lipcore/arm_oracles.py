"""References for an arm: Pinocchio, and automatic differentiation of its energies."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pinocchio as pin
import torch
from torch import Tensor
from torch.func import grad, jvp

from lipcore import FitOptions, TorqueModel, TorquePrediction, train
from lipcore.arm.learning import learn
from lipcore.data.metrics import evaluate
from lipcore.data.samples import Samples
from lipcore.estimators.task import Task
from lipcore.kernels.geometry import Geometry
from lipcore.kernels.residual import JointResidual, ResidualKernel, residual_inputs
from lipcore.online.batch import Rows
from lipcore.robots.library import Robot, load_robot
from lipcore.robots.simulation import Simulation, simulate
from lipcore.robots.urdf import RigidBody
from lipcore.training.fit import fit_estimator
from tests.lipcore.arms import random_bodies, random_geometry


def as_robot(geometry: Geometry, bodies: np.ndarray) -> Robot:
    """Return Pinocchio's model of an arm. bodies: (n, 10), base to tip."""
    model, last, n = pin.Model(), 0, geometry.n_joints
    model.gravity.linear[:] = geometry.gravity
    for j, kind in enumerate(geometry.joint_types):
        make = pin.JointModelPrismaticUnaligned if kind == "prismatic" else pin.JointModelRevoluteUnaligned
        place = pin.SE3(geometry.rotation[j], geometry.translation[j])
        last = model.addJoint(0 if j in geometry.roots else last, make(geometry.axis[j]), place, f"joint{j + 1}")
        model.appendBodyToJoint(last, pin.Inertia.FromDynamicParameters(bodies[j]), pin.SE3.Identity())
    reach = np.where(np.array(geometry.joint_types) == "prismatic", 0.4, 2.5)
    return Robot("arm", model, tuple(model.names)[1:], geometry.joint_types, -reach, reach, np.full(n, 4.0))


def arm(kinds: str, seed: int, gravity: bool = True) -> tuple[Geometry, np.ndarray, Robot]:
    """Return geometry, bodies and Pinocchio's model of random arms, see `random_geometry`."""
    geometry, bodies = random_geometry(kinds, seed, gravity), random_bodies(len(kinds), seed)
    return geometry, bodies, as_robot(geometry, bodies)


def random_motions(n: int, seed: int, size: int = 5) -> np.ndarray:
    """Return random q, dq and ddq, (N, 3, n)."""
    return np.random.default_rng(seed).uniform(-2, 2, (size, 3, n))


def train_from_geometry(
    geometry: Geometry, robot: Robot, samples: Samples, options: FitOptions, estimator: str = "rigid-body"
) -> TorqueModel:
    """Train from the true geometry, which saves the seconds of a search."""
    task = Task(samples, robot.joint_types, replace(options, arms=arms_of(geometry)))
    return fit_estimator(task, estimator, learn(task, begin=(geometry.canonical(),)))


def arms_of(geometry: Geometry) -> str:
    """Return the option `arms` of a fit for a geometry."""
    sizes = np.diff([*geometry.roots, geometry.n_joints])
    return ",".join(map(str, sizes)) if len(sizes) > 1 else ""


def record_motion(robot: Robot, seed: int, size: int = 120, noise: float = 0.01, viscous: float = 0.2) -> Samples:
    """Simulate a robot that moves over most of its range."""
    return simulate(robot, Simulation(size, speed=10, noise=noise, viscous=viscous, motion="full"), seed)


def hold_joints(samples: Samples, joints: Sequence[int], position: float) -> Samples:
    """Return samples in which some joints never move."""
    q, dq, ddq = samples.q.copy(), samples.dq.copy(), samples.ddq.copy()
    q[:, joints], dq[:, joints], ddq[:, joints] = position, 0.0, 0.0
    return replace(samples, q=q, dq=dq, ddq=ddq)


def nmse_per_joint(model: TorqueModel, unseen: Samples) -> np.ndarray:
    """Return the nMSE on another motion, (n,)."""
    answer = model.predict(unseen.q, unseen.dq, unseen.ddq)
    return np.asarray(evaluate(unseen.tau, *answer.interval).nmse)


def assert_predicts_finite_torque(model: TorqueModel, samples: Samples) -> TorquePrediction:
    """Assert finite predictions at the samples and elsewhere; return those at the samples."""
    answer = model.predict(samples.q, samples.dq, samples.ddq, covariance=True)
    elsewhere = model.predict(samples.q + 1.0, 2 * samples.dq + 0.1, samples.ddq - 1.0)
    for part in (answer.tau, answer.tau_std, answer.covariance, answer.noise_std, elsewhere.tau, elsewhere.tau_std):
        assert np.isfinite(part).all()
    assert (answer.noise_std > 0).all()
    return answer


def reversed_pendulum_model(mode: str, options: FitOptions) -> TorqueModel:
    """Train around the URDF of a pendulum whose data order the joints from tip to base. mode: of the geometry."""
    robot = load_robot("double-pendulum")
    data = simulate(robot, Simulation(80, speed=10, noise=0.002, viscous=0.02), 1)
    turned = {name: getattr(data, name)[:, ::-1].copy() for name in ("q", "dq", "ddq", "tau")}
    data = replace(data, joint_names=data.joint_names[::-1], **turned)
    body = RigidBody.from_profile(robot.name, data.joint_names, ("revolute",) * 2)
    return train(data, ("revolute",) * 2, "rigid-body", replace(options, geometry=mode), robot=body)


def energies(geometry: Geometry, bodies: np.ndarray, step: Tensor, q: Tensor, dq: Tensor) -> tuple[Tensor, Tensor]:
    """Return kinetic and potential energy of an arm whose geometry is displaced by a step, (g,).

    The step of a joint displaces its frame as `lipcore.kernels.geometry` documents: T ← T exp(turns), and shifts in T.
    """

    def places(at: Tensor) -> tuple[Tensor, Tensor]:
        turn, origin, used = torch.eye(3, dtype=at.dtype), torch.zeros(3, dtype=at.dtype), 0
        turns, origins = [], []
        for j, (kind, count) in enumerate(zip(geometry.joint_types, geometry.screws, strict=True)):
            if j in geometry.roots:
                turn, origin = torch.eye(3, dtype=at.dtype), torch.zeros(3, dtype=at.dtype)
            rotation, place, axis = map(tensor, (geometry.rotation[j], geometry.translation[j], geometry.axis[j]))
            across, part = tensor(geometry.across[j]), step[used : used + count]
            used += count
            if count == 4:
                place = place + rotation @ (part[2:] @ across)
            if count:
                rotation = rotation @ torch.linalg.matrix_exp(cross_matrix(part[:2] @ across))
            origin, turn = origin + turn @ place, turn @ rotation
            if kind == "revolute":
                turn = turn @ torch.linalg.matrix_exp(at[j] * cross_matrix(axis))
            else:
                origin = origin + turn @ axis * at[j]
            turns.append(turn)
            origins.append(origin)
        return torch.stack(turns), torch.stack(origins)

    (turns, origins), (spins, speeds) = jvp(places, (q,), (dq,))
    kinetic = potential = torch.zeros((), dtype=q.dtype)
    for turn, origin, spin, speed, body in zip(turns, origins, spins, speeds, tensor(bodies), strict=True):
        twist = turn.T @ spin  # of a rotation, Rᵀ dR/dt = ω× in the body's frame
        omega = torch.stack([twist[2, 1], twist[0, 2], twist[1, 0]])
        velocity, moment = turn.T @ speed, body[1:4]
        xx, xy, yy, xz, yz, zz = body[4:]
        inertia = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz]).reshape(3, 3)
        kinetic = kinetic + 0.5 * body[0] * velocity @ velocity + 0.5 * omega @ inertia @ omega
        kinetic = kinetic + velocity @ torch.linalg.cross(omega, moment)
        potential = potential - tensor(geometry.gravity) @ (body[0] * origin + turn @ moment)
    return kinetic, potential


def lagrangian_torque(geometry: Geometry, bodies: np.ndarray, step: Tensor | np.ndarray, motion: np.ndarray) -> Tensor:
    """Return the torque d/dt ∂L/∂dq − ∂L/∂q of one motion (3, n), differentiable by the step, (n,)."""
    q, dq, ddq = map(tensor, motion)

    def lagrangian(at: Tensor, speed: Tensor) -> Tensor:
        kinetic, potential = energies(geometry, bodies, torch.as_tensor(step), at, speed)
        return kinetic - potential

    _, change = jvp(grad(lagrangian, argnums=1), (q, dq), (dq, ddq))
    return change - grad(lagrangian, argnums=0)(q, dq)


def cross_matrix(vector: Tensor) -> Tensor:
    """Return the matrix of the cross product with a vector."""
    x, y, z = vector
    zero = torch.zeros((), dtype=vector.dtype)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)


def tensor(values: np.ndarray | Sequence[float]) -> Tensor:
    """Return numbers in double precision."""
    return torch.as_tensor(np.array(values, np.float64))


TOLERANCE = 1e-8
"""Tolerance relative to the largest number compared."""


def as_rows(samples: Samples, began: float = 1000.0) -> Rows:
    """Return all samples as rows to learn."""
    code = np.zeros(len(samples), np.uint8)
    return Rows(began + samples.t, samples.q, samples.dq, samples.ddq, samples.tau, code)


def assert_same_predictions(one: TorqueModel, other: TorqueModel, rows: Rows, tolerance: float = TOLERANCE) -> None:
    """Assert equal means and standard deviations."""
    a, b = (model.predict(rows.q, rows.dq, rows.ddq) for model in (one, other))
    np.testing.assert_allclose(a.tau, b.tau, rtol=0, atol=tolerance * np.abs(b.tau).max())
    # variances are differences of large numbers, limited by rounding
    np.testing.assert_allclose(a.tau_std**2, b.tau_std**2, rtol=1e-6, atol=tolerance * (b.tau_std**2).max())


def correction_before(samples: Samples, joints: Sequence[int]) -> ResidualKernel:
    """Return an earlier correction of some joints, so that a fit corrects them whether or not they need it."""
    inputs, none = residual_inputs(samples.motion()), JointResidual.none(samples.n_joints)
    lengthscales = np.sqrt(inputs.shape[1]) * inputs.std(axis=0).clip(1e-3)
    weights = np.ones(1)
    one = JointResidual(lengthscales, inputs[:1] / lengthscales, weights, np.eye(1), 1.0, 0.0, weights, 0.0)
    return ResidualKernel([one if joint in joints else none for joint in range(samples.n_joints)])
