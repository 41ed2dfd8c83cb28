"""Gravity, Coriolis torque and mass matrix: against Lagrange's equations, Pinocchio, the exported C and the torque."""

import ctypes
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from lipcore import FitOptions, TorqueModel, load
from lipcore.data.motion import Array, Motion
from lipcore.estimators.catalogue import make_estimator
from lipcore.export.c_writer import c_files
from lipcore.export.origin import ModelOrigin
from lipcore.model import dynamics
from lipcore.model.body import Body
from lipcore.model.equation import UnavailableComponentError
from lipcore.model.payload import Carrier
from lipcore.model.torque_model import training_range
from lipcore.posterior.basis import Basis
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.compression import build_linear
from lipcore.posterior.statistics import collect
from tests import ROOT
from tests.lipcore.arm_oracles import arm, as_robot, record_motion, train_from_geometry
from tests.lipcore.remembering import remembering_model

TYPES = ("revolute", "prismatic")
SAMPLES, STEP = 4, 1e-5
BODY = Body(2.0, np.array([0.05, -0.03, 0.12]), np.diag([0.02, 0.015, 0.01]))


def random_model(name: str) -> TorqueModel:
    """Return a model of two joints with random hyperparameters, conditioned on random torques."""
    rng = np.random.default_rng(3)
    motion, tau = Motion(*rng.uniform(-1.5, 1.5, (3, SAMPLES, 2))), rng.normal(size=(SAMPLES, 2))
    estimator = make_estimator(name, TYPES)
    like = estimator.kernel.initial(motion, tau)
    params = {name: np.asarray(rng.uniform(-1, 0.5, value.shape)) for name, value in like.items()}
    params["noise.log_std"] = np.array([-1.5, -2.0])
    outputs = np.arange(SAMPLES * 2)
    basis = Basis.build(estimator.kernel, params, motion, outputs)
    statistics = collect(basis, np.exp(2 * params["noise.log_std"]), motion, tau)
    posterior = CompactPosterior.restore(estimator.kernel, params, motion, outputs, statistics)
    return TorqueModel(estimator, ("a", "b"), TYPES, "gravity_included", {}, {}, posterior, training_range(motion), {})


def panda() -> TorqueModel:
    return load(ROOT / "models/panda-sim")


def carrying_panda() -> TorqueModel:
    carrier = Carrier(panda())
    return carrier.with_payload(carrier.known(BODY.parameters))


MODELS: dict[str, Callable[[], TorqueModel]] = {
    "lip": lambda: random_model("lip"),
    "lip-chain": lambda: random_model("lip-chain"),
    "panda": panda,
    "panda with a payload": carrying_panda,
    "friction that remembers": remembering_model,
}
ANY = pytest.mark.parametrize("name", MODELS)
CONSERVATIVE = pytest.mark.parametrize("name", [name for name in MODELS if name != "friction that remembers"])
"""Models without alternative arms, which also differ in friction."""


def states(model: TorqueModel, count: int = 4) -> Array:
    """Return states within the training range, (3, N, n)."""
    draw, limits = np.random.default_rng(1).uniform, model.training_range
    each = [draw(limits[name]["min"], limits[name]["max"], (count, model.n_joints)) for name in ("q", "dq", "ddq")]
    return np.stack(each)


def energy(model: TorqueModel, which: str, q: Array, dq: Array) -> Array:
    return dynamics.components(model, Motion(q, dq, 0 * q), [which])[which].mean  # type: ignore[list-item,index]


def along_each_joint(function: Callable[[Array], Array], q: Array) -> Array:
    """Return central differences of a function of N positions by each joint, (n, N, …)."""
    steps = STEP * np.eye(q.shape[1])
    return np.stack([(function(q + step) - function(q - step)) / (2 * STEP) for step in steps])


@CONSERVATIVE
def test_terms_follow_from_the_energies_by_lagrange(name: str) -> None:
    model = MODELS[name]()
    q, dq, _ = states(model)
    n, close = (
        model.n_joints,
        lambda one, other: np.testing.assert_allclose(one, other, atol=1e-6 * np.abs(other).max()),
    )
    eye = np.eye(n)
    kinetic = np.array(
        [[energy(model, "kinetic_energy", q, 0 * q + eye[i] + eye[j]) for j in range(n)] for i in range(n)]
    )
    own = kinetic.diagonal().T / 4  # T(e_i)
    close(model.mass_matrix(q), (kinetic - own[:, None] - own[None, :]).transpose(2, 0, 1))
    close(model.gravity(q).mean, along_each_joint(lambda at: energy(model, "potential_energy", at, 0 * at), q).T)
    slopes = along_each_joint(model.mass_matrix, q)  # dM / dq_k, (n, N, n, n)
    rate = np.einsum("kNij,Nk,Nj->Ni", slopes, dq, dq)
    close(model.coriolis(q, dq), rate - 0.5 * np.einsum("kNij,Ni,Nj->Nk", slopes, dq, dq))


@CONSERVATIVE
def test_terms_and_friction_sum_to_the_torque(name: str) -> None:
    model = MODELS[name]()
    q, dq, ddq = states(model)
    friction = dynamics.components(model, Motion(q, dq, ddq), ["friction"])["friction"].mean
    inertial = (model.mass_matrix(q) @ ddq[..., None])[..., 0]
    total = inertial + model.coriolis(q, dq) + model.gravity(q).mean + friction
    np.testing.assert_allclose(total, model.predict(q, dq, ddq).mean, rtol=1e-8, atol=1e-8)


@ANY
def test_terms_are_the_components_of_the_exact_posterior(name: str) -> None:
    model = MODELS[name]()
    q, dq, _ = states(model)
    rest = dynamics.components(model, Motion(q, 0 * q, 0 * q), ["gravity", "inertia_matrix"])
    moving = dynamics.components(model, Motion(q, dq, 0 * q), ["coriolis"])
    gravity = model.gravity(q)
    np.testing.assert_allclose(gravity.mean, rest["gravity"].mean, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(gravity.std, rest["gravity"].std, rtol=1e-5)
    np.testing.assert_allclose(model.mass_matrix(q), rest["inertia_matrix"].mean, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(model.coriolis(q, dq), moving["coriolis"].mean, rtol=1e-9, atol=1e-11)


def test_mass_matrix_of_known_bodies_is_pinocchios_with_the_rotors() -> None:
    geometry, bodies, robot = arm("RRPRRR", 50)
    samples, n = record_motion(robot, 1, 60), 6
    rotor = 0.1 * np.arange(1.0, n + 1)
    model = train_from_geometry(geometry, robot, samples, FitOptions(device="cpu", statistics="chosen"))
    assert model.arm is not None
    none, fixed = np.zeros(0), replace(model.arm, geometry=geometry, parameters=bodies, centre=bodies, rotor=rotor)
    fixed = replace(fixed, mode="fixed", expected=none, widths=none)
    chosen, before = make_estimator("rigid-body", model.joint_types, arm=fixed), model.posterior
    once = np.broadcast_to(before.noise_variance, samples.tau.shape)
    posterior = build_linear(chosen.kernel, before.params, samples, once, 0.01, 1.0, before.misfit).posterior
    model = replace(
        model, estimator=chosen, posterior=replace(posterior, weights=np.zeros_like(posterior.weights))
    )  # the torque of these bodies alone
    exact = as_robot(geometry, bodies).model
    exact.armature = rotor
    data = exact.createData()
    for q, dq, _ in states(model).transpose(1, 0, 2):
        upper, gravity = np.triu(pin.crba(exact, data, q)), pin.computeGeneralizedGravity(exact, data, q).copy()
        np.testing.assert_allclose(model.mass_matrix(q), upper + np.triu(upper, 1).T, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(model.gravity(q).mean, gravity, rtol=1e-9, atol=1e-9)
        moving = pin.nonLinearEffects(exact, data, q, dq) - gravity
        np.testing.assert_allclose(model.coriolis(q, dq), moving, rtol=1e-9, atol=1e-9)


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler, cc, which is not installed")
def test_terms_are_those_of_the_exported_c(tmp_path: Path) -> None:
    model = panda()
    for name, text in c_files(model, ModelOrigin("an-arm", 3, 7, "0123")).items():
        (tmp_path / name).write_text(text, encoding="ascii")
    library = tmp_path / "model.so"
    command = ["cc", "-shared", "-fPIC", str(tmp_path / "lipserve_model.c"), "-o", str(library), "-lm"]
    subprocess.run(command, check=True)
    loaded = ctypes.CDLL(str(library))
    for q, dq, _ in states(model).transpose(1, 0, 2):
        gravity, coriolis, matrix = np.empty(7), np.empty(7), np.empty((7, 7))
        at, moving = np.ascontiguousarray(q).ctypes, np.ascontiguousarray(dq).ctypes
        loaded.lipserve_gravity(at, gravity.ctypes)
        loaded.lipserve_coriolis(at, moving, coriolis.ctypes)
        loaded.lipserve_mass_matrix(at, matrix.ctypes)
        np.testing.assert_allclose(model.gravity(q).mean, gravity, rtol=0, atol=1e-9)
        np.testing.assert_allclose(model.coriolis(q, dq), coriolis, rtol=0, atol=1e-9)
        np.testing.assert_allclose(model.mass_matrix(q), matrix, rtol=0, atol=1e-9)


def test_black_box_affine_in_the_acceleration_has_a_mass_matrix() -> None:
    model = random_model("gip")
    q, dq, _ = states(model)
    rest = model.predict(q, dq, 0 * q).mean
    columns = np.stack([model.predict(q, dq, 0 * q + unit).mean - rest for unit in np.eye(2)], axis=2)
    np.testing.assert_allclose(model.mass_matrix(q), 0.5 * (columns + columns.mT), rtol=1e-9, atol=1e-11)
    assert np.abs(columns).max() > 1e-3


def test_models_without_a_term_say_why() -> None:
    q = np.zeros(2)
    for name in ("se", "lse"):
        with pytest.raises(UnavailableComponentError, match=f"its estimator is {name}, whose torque is not affine"):
            random_model(name).mass_matrix(q)
    with pytest.raises(UnavailableComponentError, match=r"cannot separate gravity from .* gip"):
        random_model("gip").gravity(q)
    with pytest.raises(UnavailableComponentError, match="cannot separate the Coriolis torque"):
        random_model("gip").coriolis(q, q)
    compensated = replace(panda(), torque_convention="gravity_compensated")
    with pytest.raises(UnavailableComponentError, match="trained on torque without gravity"):
        compensated.gravity(np.zeros(7))
    assert compensated.mass_matrix(np.zeros(7)).shape == (7, 7)


def test_terms_have_the_shape_of_the_query() -> None:
    model = panda()
    q, dq, _ = states(model)
    for name, arguments in (("mass_matrix", (q,)), ("coriolis", (q, dq)), ("gravity", (q,))):
        batch, one = getattr(model, name)(*arguments), getattr(model, name)(*(each[2] for each in arguments))
        if name == "gravity":
            batch, one = batch.mean, one.mean
        assert batch.shape[1:] == one.shape
        np.testing.assert_allclose(batch[2], one, rtol=1e-12, atol=1e-12)
    for wrong, message in ((q[:, :6], "q has 6 joints, expected 7"), (q * np.nan, "expected a finite number")):
        with pytest.raises(ValueError, match=message):
            model.mass_matrix(wrong)
    with pytest.raises(ValueError, match="dq has shape"):
        model.coriolis(q, dq[:1])
