"""Tests of the rigid-body estimators against Pinocchio, and of their inertial parameters."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from lipcore import FitOptions, ModelFormatError, Samples, TorqueModel, copy_model, load, save, train
from lipcore.data.metrics import evaluate
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.arm_prior import arm_of_robot
from lipcore.model.parameters import friction_coefficients, inertial_parameters
from lipcore.model.plausible import is_plausible, pseudo_inertia
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, simulate
from lipcore.robots.urdf import JointMismatchError, RigidBody

VISCOUS, COULOMB = 0.5, 0.3
BODIES = 70
"""Number of weights for the masses of seven bodies; rotors and geometry follow."""
OPTIONS = FitOptions(hyperparameter_samples=80, max_iterations=60, device="cpu", geometry="fixed")


def perturbed(urdf: str, seed: int) -> str:
    """Return the URDF with every mass and inertia off by up to 40 %."""
    rng = np.random.default_rng(seed)
    number = re.compile(r'(<mass value="|\bi[xyz][xyz]=")([^"]+)"')
    return number.sub(lambda found: f'{found[1]}{float(found[2]) * rng.uniform(0.7, 1.4)}"', urdf)


@pytest.fixture(scope="module")
def panda() -> RigidBody:
    robot = load_robot("panda")
    return RigidBody.from_profile("panda", robot.joint_names, robot.joint_types)


@pytest.fixture(scope="module")
def wrong_panda(panda: RigidBody) -> RigidBody:
    body = RigidBody.from_urdf(perturbed(panda.urdf, 3), panda.joint_names, panda.joint_types)
    assert np.abs(body.parameters()[:, 0] / panda.parameters()[:, 0] - 1).max() > 0.2
    return body


@pytest.fixture(scope="module")
def recording() -> Samples:
    """Return 300 samples of a moving Panda, with friction as smooth near standstill as the model's."""
    samples = simulate(load_robot("panda"), Simulation(300, speed=10, noise=0.005, viscous=VISCOUS), seed=1)
    return replace(samples, tau=samples.tau + COULOMB * np.tanh(samples.dq / 0.02))


@pytest.fixture(scope="module")
def unseen() -> Samples:
    return simulate(load_robot("panda"), Simulation(100, speed=10, noise=0.0, n_sinusoids=100), seed=2)


@pytest.fixture(scope="module", params=["urdf", pytest.param("zero", marks=pytest.mark.slow)])
def model(request: pytest.FixtureRequest, recording: Samples, wrong_panda: RigidBody) -> TorqueModel:
    options = replace(OPTIONS, prior=request.param)
    return train(recording, wrong_panda.joint_types, "rigid-body", options, robot=wrong_panda)


def test_robot_without_mass_needs_the_zero_prior(panda: RigidBody) -> None:
    massless = re.sub(r"<inertial>.*?</inertial>", "", panda.urdf, flags=re.DOTALL)
    body = RigidBody.from_urdf(massless, panda.joint_names, panda.joint_types)
    with pytest.raises(ValueError, match="no mass in its URDF, expected inertial parameters or prior 'zero'"):
        arm_of_robot(body)
    centre = ArmKernel(arm_of_robot(body, prior="zero")).prior_weights()
    assert centre is not None
    assert np.count_nonzero(centre) == 0
    with pytest.raises(ValueError, match="prior is 'flat', expected one of urdf, zero"):
        FitOptions(prior="flat")


def test_rigid_body_torque_is_learnt_despite_wrong_urdf(model: TorqueModel, unseen: Samples) -> None:
    # the query has no friction: only the bodies' share is compared with Pinocchio
    term = model.estimator.terms["rigid_body"]
    answer = model.posterior.predict(unseen.motion(), term)
    noise = model.noise_std
    figures = evaluate(unseen.tau, answer.mean, answer.std, 0 * noise)
    assert (figures.nmse[:6] < 1e-4).all(), figures.nmse
    assert figures.nmse[6] < 2e-3
    wrong = ArmKernel(arm_of_robot(model.robot, mode="fixed")).mean(unseen.motion())
    assert (evaluate(unseen.tau, wrong, answer.std, noise).nmse > 5 * figures.nmse).all()


def test_friction_is_recovered(model: TorqueModel) -> None:
    friction = friction_coefficients(model.posterior, model.estimator)
    assert (np.abs(friction.viscous - VISCOUS) < 3 * friction.viscous_std).all()
    assert (np.abs(friction.coulomb - COULOMB) < 3 * friction.coulomb_std).all()
    assert (friction.viscous_std < 0.1 * VISCOUS).all()
    assert (friction.coulomb_std < 0.1 * COULOMB).all()


def test_inertial_parameters_are_plausible_and_fit_as_well(model: TorqueModel, recording: Samples) -> None:
    inertia = inertial_parameters(model.posterior, model.estimator)
    assert inertia.mean.shape == inertia.std.shape == inertia.plausible.shape == (7, 10)
    assert all(np.linalg.eigvalsh(pseudo_inertia(body))[0] > 0 for body in inertia.plausible)
    assert inertia.mean_is_plausible == all(is_plausible(body) for body in inertia.mean)
    features = model.estimator.terms["rigid_body"].features(recording.motion())[:, :, :BODIES]
    moved = features @ (inertia.plausible - inertia.mean).reshape(-1)
    assert (np.sqrt(np.mean(moved**2, axis=0)) < 0.02 * recording.tau.std(axis=0)).all()


def test_pseudo_inertia_matches_pinocchio(panda: RigidBody) -> None:
    for body in panda.parameters():
        assert np.allclose(pseudo_inertia(body), pin.PseudoInertia.FromDynamicParameters(body).toMatrix(), atol=1e-12)
        assert is_plausible(body)
    assert not is_plausible(np.array([1, 0, 0, 0, 0.1, 0, 0.1, 0, 0, 0.3]))  # breaks the triangle inequality
    assert not is_plausible(-panda.parameters()[0])


def test_saved_model_loads_with_its_robot(model: TorqueModel, unseen: Samples, tmp_path: Path) -> None:
    manifest = save(model, tmp_path / "model")
    copy_model(tmp_path / "model", tmp_path / "copy")
    before = model.predict(unseen.q, unseen.dq, unseen.ddq)
    for folder in ("model", "copy"):
        again = load(tmp_path / folder)
        after = again.predict(unseen.q, unseen.dq, unseen.ddq)
        assert np.array_equal(before.tau, after.tau)
        assert np.array_equal(before.covariance, after.covariance)
        assert again.robot == model.robot
    assert manifest == json.loads((tmp_path / "copy" / "manifest.json").read_text())
    urdf = tmp_path / "copy" / "robot.urdf"
    urdf.write_text(urdf.read_text().replace("panda", "bandit", 1))
    with pytest.raises(ModelFormatError, match=r"robot\.urdf does not match the sha256"):
        load(tmp_path / "copy")
    robot = manifest["robot"]
    assert (robot["joints"], robot["matched"]) == (list(model.robot.urdf_joints), "name")
    assert (robot["sha256"], robot["prior"]) == (model.robot.sha256, model.options["prior"])
    parameters = manifest["parameters"]
    assert set(parameters["friction"]) == {"viscous", "coulomb", "offset"}
    assert [body["joint"] for body in parameters["inertia"]["bodies"]] == list(model.joint_names)


def test_model_without_robot_in_manifest_loads_from_tensors(
    model: TorqueModel, unseen: Samples, tmp_path: Path
) -> None:
    manifest = save(model, tmp_path / "model")
    del manifest["robot"]
    (tmp_path / "model" / "manifest.json").write_text(json.dumps(manifest))
    (tmp_path / "model" / "robot.urdf").unlink()
    again = load(tmp_path / "model")
    assert again.robot is None
    before, after = (each.predict(unseen.q, unseen.dq, unseen.ddq) for each in (model, again))
    np.testing.assert_allclose(after.tau, before.tau, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(after.tau_std, before.tau_std, rtol=1e-9)


def test_robot_with_other_joints_is_rejected(panda: RigidBody, recording: Samples) -> None:
    first, second, *rest = recording.joint_names
    other = replace(recording, joint_names=(second, first, *rest))
    with pytest.raises(JointMismatchError, match=r"built for .* panda_joint1, .*; the data have panda_joint2, "):
        train(other, panda.joint_types, "rigid-body", OPTIONS, robot=panda)


def test_energy_kernel_learns_a_spring(tmp_path: Path) -> None:
    """A spring at the elbow is an energy, but no rigid body."""
    robot = load_robot("double-pendulum")
    body = RigidBody.from_profile("double-pendulum", robot.joint_names, robot.joint_types)

    def spring(samples: Samples) -> Samples:
        return replace(samples, tau=samples.tau + np.stack([0 * samples.q[:, 1], 0.4 * np.sin(2 * samples.q[:, 1])], 1))

    data = spring(simulate(robot, Simulation(150, speed=10, noise=0.001), seed=1))
    unseen = spring(simulate(robot, Simulation(60, speed=10, noise=0.0), seed=2))
    options = replace(OPTIONS, hyperparameter_samples=60, max_iterations=40)
    errors = {}
    for name in ("rigid-body", "rigid-body+lip-chain"):
        model = train(data, robot.joint_types, name, options, robot=body)
        answer = model.predict(unseen.q, unseen.dq, unseen.ddq)
        errors[name] = evaluate(unseen.tau, *answer.interval).nmse[1]
    assert errors["rigid-body+lip-chain"] < 0.1 * errors["rigid-body"], errors
