"""Tests of the components of the dynamics against Pinocchio, a dense Gaussian posterior and physical laws."""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import pytest
import torch
from torch.func import jacrev

from lipcore import FitOptions, Samples, TorqueModel, train
from lipcore.data.motion import Array, Motion
from lipcore.estimators.catalogue import make_estimator
from lipcore.kernels.drive.play import ELEMENTS
from lipcore.kernels.drive.terms import SIGN_WIDTH
from lipcore.model import dynamics
from lipcore.model.functionals import EnergyKernel
from lipcore.model.torque_model import training_range
from lipcore.posterior.basis import Basis
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.statistics import collect
from lipcore.robots.library import Robot, load_robot
from lipcore.robots.simulation import Simulation, simulate
from lipcore.robots.urdf import RigidBody
from lipcore.vocabulary import COMPONENTS, offered_components
from tests.choosing import few
from tests.lipcore.oracles import (
    Energy,
    Instant,
    chain_energies,
    energy_torque,
    instant,
    lip_energies,
    torque_terms,
    with_full_counts,
)
from tests.lipcore.remembering import remembering_model, remembering_samples


class Setting(NamedTuple):
    """An estimator, its robot, and the robot's viscous friction in N·m·s/rad."""

    estimator: str
    robot: str
    viscous: float = 0.01
    prior: str = "zero"


SETTINGS = [
    Setting("lip-chain", "finger-edu"),
    Setting("lip", "finger-edu"),
    pytest.param(Setting("lip-chain", "ur5", viscous=0.5), marks=pytest.mark.slow),
    Setting("rigid-body", "ur5", viscous=0.5),
    Setting("rigid-body+lip-chain", "double-pendulum", prior="urdf"),
]
MAX_RELATIVE_ERROR = {
    "inertia_matrix": 0.01,
    "coriolis": 0.05,
    "gravity": 0.001,
    "inertial": 0.005,
    "friction": 0.01,
    "without_gravity": 0.005,
    "kinetic_energy": 0.002,
    "potential_energy": 0.002,
    "forward_dynamics": 0.05,
}
"""About three times the measured error, relative to the largest value."""


class Case(NamedTuple):
    """A model, an unseen motion of its robot, the components there, and Pinocchio's values."""

    robot: Robot
    model: TorqueModel
    unseen: Samples
    found: dict[str, dynamics.Estimate]
    truth: dict[str, np.ndarray]


@pytest.fixture(scope="module", params=SETTINGS, ids=lambda setting: f"{setting.estimator} {setting.robot}")
def case(request: pytest.FixtureRequest) -> Case:
    setting = request.param
    robot, options = load_robot(setting.robot), FitOptions(100, max_iterations=150, device="cpu", prior=setting.prior)
    samples = simulate(robot, Simulation(n_samples=150, speed=10, noise=1e-5, viscous=setting.viscous), seed=1)
    bodies = None
    if setting.estimator.startswith("rigid-body"):
        bodies = RigidBody.from_profile(setting.robot, samples.joint_names, robot.joint_types)
    model = with_full_counts(train(samples, robot.joint_types, setting.estimator, options, robot=bodies), samples)
    unseen = simulate(robot, Simulation(n_samples=40, n_sinusoids=100, speed=10, noise=0.0), seed=7)
    found = dynamics.components(model, unseen.motion(), dynamics.COMPONENTS, unseen.tau)
    reference = dynamics.reference_posture(model)
    return Case(robot, model, unseen, found, pinocchio_components(robot, unseen, reference, setting.viscous))


def pinocchio_components(robot: Robot, unseen: Samples, reference: np.ndarray, viscous: float) -> dict[str, np.ndarray]:
    model, data, rest = robot.model, robot.model.createData(), np.zeros(robot.n_joints)
    bottom = pin.computePotentialEnergy(model, data, robot.configuration(reference))

    def components_of(row: int) -> dict[str, np.ndarray | float]:
        q, v, a = robot.configuration(unseen.q[row]), unseen.dq[row], unseen.ddq[row]
        upper, friction = np.triu(pin.crba(model, data, q)), viscous * v
        inertia = upper + np.triu(upper, 1).T
        gravity = pin.computeGeneralizedGravity(model, data, q).copy()
        return {
            "inertia_matrix": inertia,
            "gravity": gravity,
            "coriolis": pin.rnea(model, data, q, v, rest) - gravity,
            "inertial": inertia @ a,
            "friction": friction,
            "without_gravity": pin.rnea(model, data, q, v, a) - gravity + friction,
            "kinetic_energy": pin.computeKineticEnergy(model, data, q, v),
            "potential_energy": pin.computePotentialEnergy(model, data, q) - bottom,
            "forward_dynamics": pin.aba(model, data, q, v, unseen.tau[row] - friction).copy(),
        }

    rows = [components_of(row) for row in range(len(unseen))]
    return {name: np.array([row[name] for row in rows]) for name in dynamics.COMPONENTS}


@pytest.mark.parametrize("name", dynamics.COMPONENTS)
def test_components_match_pinocchio(case: Case, name: str) -> None:
    estimate, truth = case.found[name], case.truth[name]
    error, std, size = np.abs(estimate.mean - truth), estimate.std, np.abs(truth).max()
    assert estimate.mean.shape == estimate.std.shape == truth.shape
    assert error.max() < MAX_RELATIVE_ERROR[name] * size
    assert (error <= 4 * std + 1e-9 * size).mean() > 0.9
    assert std.max() > 0


@pytest.mark.slow
def test_panda_reaches_the_documented_accuracy() -> None:
    robot, options = load_robot("panda"), FitOptions(100, max_iterations=100, starts=1, device="cpu")
    samples = simulate(robot, Simulation(500, motion="middle", speed=10, noise=0.0), seed=5)
    model = train(samples, robot.joint_types, "lip-chain", options)
    unseen = simulate(robot, Simulation(501, n_sinusoids=100, motion="middle", speed=10, noise=0.0), seed=101)
    found = dynamics.components(model, unseen.motion(), ["inertia_matrix", "gravity"])
    truth = pinocchio_components(robot, unseen, unseen.q[0], 0.0)
    assert (np.linalg.eigvalsh(found["inertia_matrix"].mean) > 0).all()
    for name, max_error in (("inertia_matrix", 0.025), ("gravity", 0.001)):
        error = float(np.abs(found[name].mean - truth[name]).max() / np.abs(truth[name]).max())
        print(f"\n{name}: {error:.1e}")  # noqa: T201
        assert error < max_error


def test_parts_sum_to_the_torque(case: Case) -> None:
    total = sum(case.found[name].mean for name in ("inertial", "coriolis", "gravity", "friction"))
    torque = case.model.posterior.mean(case.unseen.motion())
    assert np.abs(total - torque).max() < 1e-9 * max(1.0, float(np.abs(torque).max()))


def test_inertia_is_consistent_with_energy_and_torque(case: Case) -> None:
    """Check T = ½ dqᵀ M dq, inertial = M ddq, and the symmetry of M for the posterior means."""
    inertia, motion = case.found["inertia_matrix"], case.unseen.motion()
    assert (inertia.mean == inertia.mean.mT).all()
    assert (inertia.std == inertia.std.mT).all()
    assert (np.linalg.eigvalsh(inertia.mean)[:, 0] > 0).all()
    kinetic = 0.5 * np.einsum("ki,kij,kj->k", motion.dq, inertia.mean, motion.dq)
    assert np.abs(case.found["kinetic_energy"].mean - kinetic).max() < 1e-7 * np.abs(kinetic).max()
    inertial = np.einsum("kij,kj->ki", inertia.mean, motion.ddq)
    assert np.abs(case.found["inertial"].mean - inertial).max() < 1e-7 * np.abs(inertial).max()


@pytest.mark.slow
@pytest.mark.parametrize("row", [0, 17])
def test_forward_dynamics_uncertainty_matches_its_linearisation(case: Case, row: int) -> None:
    """Use the joint posterior of the torques in bias and inertia, and the derivative of the solution."""
    posterior, motion, n = case.model.posterior, case.unseen.motion()[row : row + 1], case.robot.n_joints
    tau = case.unseen.tau[row]
    ddq = np.concatenate([np.zeros((1, n)), np.eye(n)])
    stack = Motion(np.tile(motion.q, (n + 1, 1)), np.tile(motion.dq, (n + 1, 1)), ddq)
    white = posterior.whiten(posterior.cross(posterior.kernel, stack))
    prior = posterior.kernel.symmetric_gram(posterior.params, stack)
    covariance = prior - white.T @ white

    def solve(torques: torch.Tensor) -> torch.Tensor:
        inertia = (torques[1:] - torques[0]).T
        return torch.linalg.solve(inertia, torch.from_numpy(tau) - torques[0])

    jacobian = jacrev(solve)(torch.from_numpy(posterior.mean(stack))).reshape(n, -1).numpy()
    expected = (jacobian @ covariance @ jacobian.T).diagonal()
    found = np.square(case.found["forward_dynamics"].std[row] / posterior.std_factor)
    # the prior is wider by seven digits, so rounding costs as many digits on either side
    rounding = np.finfo(np.float64).eps * (np.abs(jacobian) @ np.abs(prior) @ np.abs(jacobian.T)).diagonal()
    assert (np.abs(found - expected) <= 2e-2 * expected + 100 * rounding).all()


def test_potential_energy_is_zero_at_its_reference(case: Case) -> None:
    q = dynamics.reference_posture(case.model)[None]
    found = dynamics.components(case.model, Motion(q, 0 * q, 0 * q), ["potential_energy", "kinetic_energy"])
    for estimate in found.values():
        assert estimate.mean.tolist() == estimate.std.tolist() == [0.0]


def test_rate_of_energy_is_power(case: Case) -> None:
    """Check d/dt (T + V) = dq · tau without friction, by a central difference of fourth order in time."""
    motion, step, names = case.unseen.motion()[::4], 1e-3, ["kinetic_energy", "potential_energy"]

    def energy(t: float) -> Array:
        moved = Motion(motion.q + t * motion.dq + 0.5 * t**2 * motion.ddq, motion.dq + t * motion.ddq, motion.ddq)
        both = dynamics.components(case.model, moved, names)
        return both["kinetic_energy"].mean + both["potential_energy"].mean

    rate = (8 * (energy(step) - energy(-step)) - (energy(2 * step) - energy(-2 * step))) / (12 * step)
    torque = sum(case.found[name].mean for name in ("inertial", "coriolis", "gravity"))[::4]
    power = (motion.dq * torque).sum(1)
    assert np.abs(rate - power).max() < 1e-5 * np.abs(power).max()


def test_torque_is_affine_in_acceleration_and_quadratic_in_velocity(case: Case) -> None:
    motion = case.unseen.motion()[::4]
    zero = np.zeros_like(motion.q)
    terms = [term for name, term in case.model.estimator.terms.items() if name != "friction"]

    def torque(dq: Array, ddq: Array) -> Array:
        return sum(case.model.posterior.mean(Motion(motion.q, dq, ddq), term) for term in terms)

    rest, size = torque(zero, zero), np.abs(torque(motion.dq, motion.ddq)).max()
    assert np.abs(torque(zero, -3 * motion.ddq) - rest + 3 * (torque(zero, motion.ddq) - rest)).max() < 1e-6 * size
    assert np.abs(torque(-2 * motion.dq, zero) - rest - 4 * (torque(motion.dq, zero) - rest)).max() < 1e-6 * size


def test_invalid_requests_are_rejected(case: Case) -> None:
    motion, tau = case.unseen.motion()[:2], case.unseen.tau[:2]
    with pytest.raises(dynamics.UnavailableComponentError, match="component is 'mass', expected one that estimator"):
        dynamics.components(case.model, motion, ["gravity", "mass"])
    q = np.zeros((1, 5))
    with pytest.raises(ValueError, match="motion has 5 joints, expected"):
        dynamics.components(case.model, Motion(q, q, q), ["gravity"])
    with pytest.raises(ValueError, match="tau is None, expected a torque for forward_dynamics"):
        dynamics.components(case.model, motion, ["forward_dynamics"])
    with pytest.raises(ValueError, match="tau is given, expected None without forward_dynamics"):
        dynamics.components(case.model, motion, ["gravity"], tau)
    with pytest.raises(ValueError, match=r"tau has shape \(1, ., expected|tau has shape \(1, .\), expected \(2, .\)"):
        dynamics.components(case.model, motion, ["forward_dynamics"], tau[:1])


TYPES = ("revolute", "prismatic")
N, SAMPLES, QUERIES = 2, 3, 2
EACH_QUERY = few(range(QUERIES), lambda row: row == 0)


ENERGIES = {"lip": lip_energies, "lip-chain": chain_energies}


class SmallModel(NamedTuple):
    """A random model, the energies of its prior, the covariance of the measured torques, and queries."""

    model: TorqueModel
    motion: Motion
    tau: Array
    energies: list[Energy]
    gram: np.ndarray
    query: Motion


@pytest.fixture(scope="module", params=ENERGIES)
def small_model(request: pytest.FixtureRequest) -> SmallModel:
    rng = np.random.default_rng(3)
    motion, query = (Motion.from_arrays(*rng.uniform(-1.5, 1.5, (3, count, N))) for count in (SAMPLES, QUERIES))
    tau = rng.normal(size=(SAMPLES, N))
    estimator, outputs = make_estimator(request.param, TYPES), np.arange(SAMPLES * N)
    like = estimator.kernel.initial(motion, tau)
    params = {name: np.asarray(rng.uniform(-1, 0.5, value.shape)) for name, value in like.items()}
    params["noise.log_std"] = np.array([-1.5, -2.0])
    variance = np.exp(2 * params["noise.log_std"])
    statistics = collect(Basis.build(estimator.kernel, params, motion, outputs), variance, motion, tau)
    posterior = CompactPosterior.restore(estimator.kernel, params, motion, outputs, statistics)
    span = training_range(motion)
    model = TorqueModel(estimator, ("a", "b"), TYPES, "gravity_included", {}, {}, posterior, span, {})
    energies, data = ENERGIES[request.param](TYPES, params), instants_of(motion)
    gram = torque_covariance(energies, data, data) + friction_covariance(params, data, data)
    return SmallModel(model, motion, tau, energies, gram + np.diag(np.tile(variance, SAMPLES)), query)


def torque_covariance(energies: list[Energy], xs: Sequence[Instant], ys: Sequence[Instant]) -> np.ndarray:
    """Return the covariance of the torques of the energies alone, (len(xs) n, len(ys) n)."""
    return np.block([[torque_terms(energies, x, y).sum(0).numpy() for y in ys] for x in xs])


def friction_covariance(params: Mapping[str, Array], xs: Sequence[Instant], ys: Sequence[Instant]) -> np.ndarray:
    variances = np.exp(2 * params["friction.log_std"])

    def features(v: Array) -> np.ndarray:
        return np.stack([v, np.tanh(np.asarray(v) / SIGN_WIDTH), np.ones(N)], axis=1)

    return np.block([[np.diag((features(x[1]) * variances * features(y[1])).sum(1)) for y in ys] for x in xs])


def instants_of(motion: Motion) -> list[Instant]:
    return [instant(motion, row) for row in range(SAMPLES)]


def condition(small: SmallModel, prior: np.ndarray, cross: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and std of quantities with prior covariance (k, k) and covariance (k, m) with the torques."""
    solved = np.linalg.solve(small.gram, cross.T)
    return solved.T @ small.tau.ravel(), np.sqrt(np.diag(prior - cross @ solved))


def assert_estimate(found: dynamics.Estimate, row: int, mean: np.ndarray, std: np.ndarray) -> None:
    np.testing.assert_allclose(found.mean[row].ravel(), mean, rtol=1e-7, atol=1e-10)
    np.testing.assert_allclose(found.std[row].ravel(), std, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("row", EACH_QUERY)
def test_energies_match_the_dense_posterior(small_model: SmallModel, row: int) -> None:
    found = dynamics.components(small_model.model, small_model.query, ["kinetic_energy", "potential_energy"])
    x, data = instant(small_model.query, row), instants_of(small_model.motion)
    origin = dynamics.reference_posture(small_model.model)
    reference = tuple(map(torch.as_tensor, (origin, np.zeros(N), np.zeros(N))))
    torques = np.array([[energy_torque(small_model.energies, at, y).numpy() for y in data] for at in (x, reference)])
    torques = torques.transpose(0, 2, 1, 3).reshape(2, len(small_model.energies), -1)  # (at, energy, m)

    def value(which: int, at: Instant, other: Instant) -> float:
        return float(small_model.energies[which].kernel(*at[:2], *other[:2]))

    kinetic = sum(value(which, x, x) for which in range(1, N + 1))
    expected = condition(small_model, np.array([[kinetic]]), torques[0, 1:].sum(0)[None])
    assert_estimate(found["kinetic_energy"], row, *expected)

    potential = value(0, x, x) - 2 * value(0, x, reference) + value(0, reference, reference)
    expected = condition(small_model, np.array([[potential]]), (torques[0, 0] - torques[1, 0])[None])
    assert_estimate(found["potential_energy"], row, *expected)


@pytest.mark.slow
@pytest.mark.parametrize("row", EACH_QUERY)
def test_torques_and_inertia_match_the_dense_posterior(small_model: SmallModel, row: int) -> None:
    q, v, a = instant(small_model.query, row)
    zero, eye = torch.zeros(N, dtype=torch.float64), torch.eye(N, dtype=torch.float64)
    stack = [(q, zero, zero), (q, v, zero), (q, zero, a), *((q, zero, eye[j]) for j in range(N))]
    prior = torque_covariance(small_model.energies, stack, stack)
    cross = torque_covariance(small_model.energies, stack, instants_of(small_model.motion))
    rest, moving, accelerating, *pushes = np.split(np.eye(len(stack) * N), len(stack))
    column = [push - rest for push in pushes]
    differences = {
        "gravity": rest,
        "coriolis": moving - rest,
        "inertial": accelerating - rest,
        "inertia_matrix": np.stack([column[j][i] for i, j in product(range(N), range(N))]),
    }
    found = dynamics.components(small_model.model, small_model.query, list(differences))
    for name, rows in differences.items():
        assert_estimate(found[name], row, *condition(small_model, rows @ prior @ rows.T, rows @ cross))


@pytest.mark.parametrize("row", EACH_QUERY)
def test_torque_without_gravity_matches_the_dense_posterior(small_model: SmallModel, row: int) -> None:
    """The prior of a difference of two torques, and of the friction of one of them."""
    q, v, a = instant(small_model.query, row)
    zero, minus = torch.zeros(N, dtype=torch.float64), np.concatenate([np.eye(N), -np.eye(N)], axis=1)
    params, data, stack = (
        small_model.model.posterior.params,
        instants_of(small_model.motion),
        [(q, v, a), (q, zero, zero)],
    )
    prior = minus @ torque_covariance(small_model.energies, stack, stack) @ minus.T
    cross = minus @ torque_covariance(small_model.energies, stack, data)
    prior, cross = (
        prior + friction_covariance(params, stack[:1], stack[:1]),
        cross + friction_covariance(params, stack[:1], data),
    )
    found = dynamics.components(small_model.model, small_model.query, ["without_gravity"])["without_gravity"]
    assert_estimate(found, row, *condition(small_model, prior, cross))


@pytest.mark.parametrize("row", EACH_QUERY)
def test_friction_matches_the_dense_posterior(small_model: SmallModel, row: int) -> None:
    params, x, data = small_model.model.posterior.params, [instant(small_model.query, row)], small_model.motion
    expected = condition(
        small_model, friction_covariance(params, x, x), friction_covariance(params, x, instants_of(data))
    )
    friction = dynamics.components(small_model.model, small_model.query, ["friction"])["friction"]
    assert_estimate(friction, row, *expected)


def test_components_follow_the_deflections_of_a_motion() -> None:
    model, samples = remembering_model(), remembering_samples(seed=8, size=200)
    followed = model.deflections_along(samples.t, samples.q, samples.dq)
    np.testing.assert_array_equal(followed, samples.deflections)
    certain = (followed[:, len(ELEMENTS) :] == 0).all(axis=(1, 2))
    assert certain.sum() > 50
    samples = samples.rows(certain)
    known = samples.deflections
    motion = samples.motion()
    tau = model.predict(motion.q, motion.dq, motion.ddq, deflections=known).tau
    parts = dynamics.components(model, motion, ("inertial", "coriolis", "gravity", "friction"))
    np.testing.assert_allclose(sum(each.mean for each in parts.values()), tau, rtol=1e-6, atol=1e-9)
    found = dynamics.components(model, motion, ["forward_dynamics"], tau)["forward_dynamics"].mean
    np.testing.assert_allclose(found, motion.ddq, atol=1e-6 * np.abs(motion.ddq).max())


@pytest.mark.parametrize("name", ["lip", "lip-chain", "se", "gip", "lse"])
def test_all_components_are_offered_if_the_torque_follows_from_energies(name):
    terms = [term for part, term in make_estimator(name, ("revolute",) * 2).terms.items() if part != "friction"]
    follows = all(isinstance(term, EnergyKernel) for term in terms)
    assert offered_components(name) == (COMPONENTS if follows else ("friction",))
