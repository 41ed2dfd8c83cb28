"""Tests of a model exported as C: the compiled code matches the model, and its self-test works."""

import ctypes
import re
import shutil
import subprocess
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from fractions import Fraction
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from lipcore import FitOptions, TorqueModel, load, train
from lipcore.arm.learning import learn
from lipcore.data.motion import Motion
from lipcore.data.samples import Samples
from lipcore.estimators.catalogue import make_estimator
from lipcore.estimators.task import Task
from lipcore.export.c_weights import UnsupportedEstimatorError
from lipcore.export.c_writer import HEADER, SOURCE, c_files
from lipcore.export.origin import ModelOrigin
from lipcore.kernels.base import PairKernel
from lipcore.kernels.drive.play import ELEMENTS, MAX_GAP_S, PlayState, element_widths
from lipcore.kernels.drive.terms import drive_terms
from lipcore.model import dynamics
from lipcore.model.body import Body
from lipcore.model.payload import Carrier
from lipcore.online.batch import Rows
from lipcore.online.learner import OnlineModel
from lipcore.online.transfer import consolidate
from lipcore.posterior.compression import build_linear
from lipcore.posterior.misfit import Misfit
from lipcore.training.correction import correct
from lipcore.training.fit import fit_estimator
from lipcore.vocabulary import DRIVE_KINDS, DriveKind
from tests import ROOT
from tests.choosing import few, slow
from tests.clients.cpp.building import sanitizers
from tests.lipcore.arm.test_model import with_alternatives
from tests.lipcore.arm_oracles import (
    arm,
    as_robot,
    correction_before,
    record_motion,
    reversed_pendulum_model,
    train_from_geometry,
)

OPTIONS = FitOptions(device="cpu", statistics="chosen")
ORIGIN = ModelOrigin("an-arm", 3, 7, "0123")
FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2")
PANDA = ROOT / "models/panda-sim"
INERTIA = np.array([[0.020, 0.003, 0.001], [0.003, 0.015, -0.002], [0.001, -0.002, 0.010]])
BODY = Body(2.0, np.array([0.05, -0.03, 0.12]), INERTIA)

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler, cc, which is not installed")


def run(folder: Path, *command: str) -> str:
    """Run a command in a folder and return its output."""
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def write_files(files: dict[str, str], folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    for name, text in files.items():
        (folder / name).write_text(text, encoding="ascii")


def compile_library(files: dict[str, str], folder: Path, *more: str) -> Path:
    """Compile the source as a shared library, without warnings."""
    write_files(files, folder)
    run(folder, "cc", *FLAGS, *more, "-shared", "-fPIC", SOURCE, "-o", "model.so", "-lm")
    return folder / "model.so"


class Payload(ctypes.Structure):
    _fields_ = [("mass", ctypes.c_double), ("com", ctypes.c_double * 3), ("inertia", ctypes.c_double * 9)]


def c_payload(body: Body) -> Payload:
    inertia = np.zeros((3, 3)) if body.inertia is None else body.inertia
    return Payload(body.mass, (ctypes.c_double * 3)(*body.com), (ctypes.c_double * 9)(*inertia.ravel()))


def c_array(row: np.ndarray) -> ctypes.Array:
    return (ctypes.c_double * len(row)).from_buffer(row)


def evaluate_library(path: Path, motion: np.ndarray, body: Body | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation of motions (3, N, n), and check the function of the mean alone."""
    library, motion = ctypes.CDLL(str(path)), np.ascontiguousarray(motion)
    tau, alone, std = (np.full_like(motion[0], np.nan) for _ in range(3))
    carried = None if body is None else ctypes.byref(c_payload(body))
    for k in range(motion.shape[1]):
        query = [c_array(part[k]) for part in motion]
        if body is None:
            library.lipserve_torque(*query, c_array(alone[k]))
            library.lipserve_torque_std(*query, c_array(tau[k]), c_array(std[k]))
        else:
            library.lipserve_torque_payload(*query, carried, c_array(alone[k]))
            library.lipserve_torque_std_payload(*query, carried, c_array(tau[k]), c_array(std[k]))
    np.testing.assert_array_equal(alone, tau)
    return tau, std


def draw_motions(model: TorqueModel, count: int, seed: int, beyond: float = 1.0) -> np.ndarray:
    """Return motions (3, N, n) within the training range times `beyond`."""
    draw, limits = np.random.default_rng(seed).uniform, model.training_range
    each = [draw(limits[name]["min"], limits[name]["max"], (count, model.n_joints)) for name in ("q", "dq", "ddq")]
    return beyond * np.stack(each)


def evaluate_exactly(model: TorqueModel, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return tau and tau_std by the posterior's formulas, in exact fractions."""
    posterior, query = model.posterior, Motion.from_arrays(*motion)
    basis, n = posterior.basis, model.n_joints
    features = np.concatenate([each.features(query) for each in basis.linear], axis=2)
    prior = np.concatenate([each.variances(posterior.params) for each in basis.linear])
    means = [each.prior_weights() for each in basis.linear]
    sizes = [each.regressor().size for each in basis.linear]
    centre = np.concatenate([np.zeros(size) if mean is None else mean for mean, size in zip(means, sizes, strict=True)])
    fraction = np.frompyfunc(Fraction, 1, 1)
    cross, first = fraction(features) * fraction(prior), len(basis.outputs)
    before = np.zeros(query.q.shape)
    if basis.term is not None:
        inducing = PairKernel.gram(basis.term, posterior.params, basis.inducing, query)[basis.outputs]
        inducing = inducing.reshape(first, len(query), n).transpose(1, 2, 0)
        cross = np.concatenate([fraction(inducing), cross], axis=2)
        before = PairKernel.variance(basis.term, posterior.params, query).diagonal(axis1=1, axis2=2)
    tau = (cross @ fraction(posterior.weights) + fraction(features) @ fraction(centre)).astype(float)
    squares = (cross @ fraction(posterior.root).T) ** 2
    variance = fraction(before) - squares[..., :first].sum(2) + squares[..., first:].sum(2)
    variance = variance.astype(float) * posterior.std_factor**2 + posterior.misfit.variance(query)
    if basis.residual is not None:
        tau += basis.residual.mean(query)
        variance += basis.residual.beyond(query)
    return tau, np.sqrt(np.maximum(variance, posterior.floor))


def train_arm(kinds: str, seed: int, estimator: str = "rigid-body", options: FitOptions = OPTIONS) -> TorqueModel:
    geometry, _, robot = arm(kinds, seed)
    return train_from_geometry(geometry, robot, record_motion(robot, 1, 100), options, estimator)


def train_with_energies(kinds: str, seed: int) -> TorqueModel:
    return train_arm(
        kinds, seed, "rigid-body+lip-chain", replace(OPTIONS, hyperparameter_samples=20, max_iterations=3, starts=1)
    )


def train_with_correction(kinds: str, seed: int) -> TorqueModel:
    """Train an arm with a local correction of its first two joints, and teach both with a stream."""
    geometry, _, robot = arm(kinds, seed)
    samples = record_motion(robot, 1, 200)
    samples = replace(samples, tau=samples.tau + 0.1 * np.sin(9 * samples.q))
    task = Task(samples, robot.joint_types, OPTIONS)
    before = correction_before(samples, (0, 1))
    learnt = learn(task, begin=(geometry.canonical(),))
    model = fit_estimator(task, "rigid-body+local", learnt, correct=partial(correct, before=before))
    parts = (samples.t, samples.q, samples.dq, samples.ddq, samples.tau + 0.05 * np.cos(9 * samples.q))
    return consolidate(OnlineModel.start(model).learn(Rows(*parts, np.zeros(len(samples), np.uint8))))


def with_misfit(model: TorqueModel) -> TorqueModel:
    """Return the model with every contribution to the variance."""
    rng, n = np.random.default_rng(0), model.n_joints
    rows = np.stack([rng.uniform(0.1, 1.0, n), np.full(n, 0.1), *rng.uniform(0.5, 1.0, (4, n))])
    misfit = Misfit.unpacked(rows)
    floor = np.array([1e-4, 10.0, *[1e-4] * (n - 2)])
    return replace(model, posterior=replace(model.posterior, misfit=misfit, floor=floor, std_factor=1.3))


def predicted_samples(model: TorqueModel) -> Samples:
    """Return samples of the model's own torque."""
    motion, names = draw_motions(model, 100, 1), model.joint_names
    tau, *_ = model.evaluator.many(*motion)
    return Samples(names, 0.01 * np.arange(100), np.zeros(100, int), *motion, tau)


def train_with_alternatives() -> TorqueModel:
    model = train_arm("RPR", 51)
    return with_alternatives(model, predicted_samples(model), 2)


def with_drive(model: TorqueModel, *kinds: DriveKind) -> TorqueModel:
    """Return the model of an arm with these kinds of friction."""
    rng, n, posterior, samples = np.random.default_rng(0), model.n_joints, model.posterior, predicted_samples(model)
    samples = replace(samples, tau=samples.tau + rng.standard_normal(samples.tau.shape))
    changed = replace(model.arm, drive=kinds, acceleration=rng.uniform(1.0, 5.0, n))
    estimator = make_estimator("rigid-body", model.joint_types, arm=changed)
    widths = posterior.params["friction.log_std"]
    more = np.repeat(widths[:, 1:2], len(drive_terms(kinds)) - 3, axis=1)
    params = {**posterior.params, "friction.log_std": np.concatenate([widths, more], axis=1)}
    misfit = replace(posterior.misfit, still=rng.uniform(0.1, 1.0, n))
    if "play" in kinds:
        elements = element_widths(model.joint_types)
        misfit = replace(misfit, elements=np.stack([rng.uniform(0.1, 1.0, elements.shape), elements]))
    variance = np.broadcast_to(posterior.noise_variance, samples.tau.shape)
    made = build_linear(estimator.kernel, params, samples, variance, 0.01, 1.0, misfit)
    return replace(model, estimator=estimator, posterior=made.posterior)


def train_with_alternatives_and_drive() -> TorqueModel:
    model = with_drive(train_arm("RPR", 51), *DRIVE_KINDS)
    return with_alternatives(model, predicted_samples(model), 2)


MODELS = {
    "panda": lambda: load(PANDA),
    "prismatic": lambda: train_arm("RPR", 51),
    "prismatic first": lambda: train_arm("PRR", 50),
    "alternatives": train_with_alternatives,
    "fixed, from its tip": lambda: reversed_pendulum_model("fixed", OPTIONS),
    "calibrated, from its tip": lambda: reversed_pendulum_model("calibrate", OPTIONS),
    "friction of slow joints": lambda: with_drive(train_arm("RRR", 50), "stribeck"),
    "friction of all kinds": lambda: with_drive(train_arm("RRR", 50), *DRIVE_KINDS),
    "friction of all kinds, alternatives": train_with_alternatives_and_drive,
    "play, from its tip": lambda: with_drive(reversed_pendulum_model("fixed", OPTIONS), "play"),
    "misfit": lambda: with_misfit(train_arm("RRR", 50)),
    "energies": lambda: with_misfit(train_with_energies("RRR", 50)),
    "local": lambda: train_with_correction("RPR", 51),
    "energies of a prismatic joint": lambda: train_with_energies("RPR", 51),
}


@needs_compiler
@pytest.mark.parametrize("name", few(MODELS, kept=lambda name: name == "panda"))
def test_compiled_numbers_match_the_model(name: str, tmp_path: Path) -> None:
    model = MODELS[name]()
    path = compile_library(c_files(model, ORIGIN), tmp_path)
    assert ctypes.CDLL(str(path)).lipserve_selftest() == 0
    for seed, beyond in ((1, 1.0), (2, 3.0)):
        motion = draw_motions(model, 1500, seed, beyond)
        tau, std = evaluate_library(path, motion)
        expected, tau_std, *_ = model.evaluator.many(*motion)
        np.testing.assert_allclose(tau, expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())
        np.testing.assert_allclose(std, tau_std, rtol=1e-9)
        few = 1 if model.n_joints > 3 else 30
        mean, deviation = evaluate_exactly(model, motion[:, :few])
        np.testing.assert_allclose(tau[:few], mean, rtol=1e-9, atol=1e-12 * np.abs(mean).max())
        np.testing.assert_allclose(std[:few], deviation, rtol=1e-9)


class CompiledState:
    """A state in a compiled library, and the torque that follows from it."""

    def __init__(self, path: Path, n: int) -> None:
        size = ctypes.c_double * (n * (2 * len(ELEMENTS) + 2))
        self._library = ctypes.CDLL(str(path))
        self._state = type("State", (ctypes.Structure,), {"_fields_": [("numbers", size), ("known", ctypes.c_int)]})()
        self._library.lipserve_start(ctypes.byref(self._state))

    @property
    def numbers(self) -> list[float]:
        return list(self._state.numbers)

    def update(self, q: np.ndarray, dq: np.ndarray, dt: float) -> None:
        self._library.lipserve_update(ctypes.byref(self._state), c_array(q), c_array(dq), ctypes.c_double(dt))

    def evaluate(self, motion: np.ndarray, is_used: bool = True) -> np.ndarray:
        """Return mean and standard deviation of a query, (2, n), and check the mean alone. motion: (3, n)."""
        query, state = [c_array(row) for row in motion], ctypes.byref(self._state) if is_used else None
        alone, out = np.empty_like(motion[0]), np.empty_like(motion[:2])
        self._library.lipserve_torque_state(*query, None, state, *map(c_array, out))
        self._library.lipserve_torque_state(*query, None, state, c_array(alone), None)
        np.testing.assert_array_equal(alone, out[0])
        return out


def turning_motion(model: TorqueModel, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return times (N,) and motions (3, N, n) with turns, stops, gaps, steps and a clock that is set back."""
    rng, n = np.random.default_rng(3), model.n_joints
    dt = rng.uniform(0.001, 0.02, count)
    dt[[50, 90, 130, 170]] = 1.01 * MAX_GAP_S, 0.99 * MAX_GAP_S, -0.1, 0.0
    time = np.cumsum(dt)
    dq = 0.3 * np.sin(np.cumsum(rng.uniform(0.0, 0.3, (count, n)), axis=0)) * (rng.random((count, n)) < 0.7)
    moved = 0.5 * (dq[1:] + dq[:-1]) * dt[1:, None] + 1e-4 * rng.standard_normal((count - 1, n))
    moved[[29, 69], n - 1] += 1.01 * element_widths(model.joint_types)[-1, -1], 0.9 * ELEMENTS[0]
    q = np.concatenate([np.zeros((1, n)), moved]).cumsum(axis=0)
    return time, np.stack([q, dq, 10 * rng.standard_normal((count, n))])


PLAY_MODELS = ("friction of all kinds, alternatives", "friction of all kinds", "play, from its tip")


@needs_compiler
@pytest.mark.parametrize("name", few(PLAY_MODELS, kept=lambda name: name == PLAY_MODELS[0]))
def test_state_follows_the_motion(name: str, tmp_path: Path) -> None:
    model = MODELS[name]()
    state = CompiledState(compile_library(c_files(model, ORIGIN), tmp_path), model.n_joints)
    time, motion = turning_motion(model, 400)
    widths = element_widths(model.joint_types)
    deflections, _ = PlayState.unknown(model.n_joints).follow(time, *motion[:2], widths)
    followed = np.empty((2, *motion.shape[1:]))
    for k, dt in enumerate(np.diff(time, prepend=time[0])):
        state.update(*motion[:2, k], dt)
        followed[:, k] = state.evaluate(np.ascontiguousarray(motion[:, k]))
    expected, tau_std, *_ = model.evaluator.many(*motion, deflections=deflections)
    np.testing.assert_allclose(followed[0], expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_allclose(followed[1], tau_std, rtol=1e-9)
    unaware, wider, *_ = model.evaluator.many(*motion)
    assert (np.abs(unaware - expected) > 1e-3).any()
    assert (wider > 1.1 * tau_std).any()


class Parts:
    """Parts of the torque by a compiled library."""

    def __init__(self, path: Path, n: int, body: Body | None = None) -> None:
        self._library, self._n = ctypes.CDLL(str(path)), n
        self._payload = None if body is None else ctypes.byref(c_payload(body))

    def of(self, motion: np.ndarray) -> dict[str, np.ndarray]:
        """Return the parts at motions (3, N, n), by the names of components."""
        n, count = self._n, motion.shape[1]
        out = {name: np.full((count, n), np.nan) for name in ("gravity", "coriolis", "friction")}
        out["inertia_matrix"] = np.full((count, n * n), np.nan)
        for k in range(count):
            q, dq, ddq = (c_array(np.ascontiguousarray(part[k])) for part in motion)
            rows = {name: c_array(values[k]) for name, values in out.items()}
            self._library.lipserve_gravity_payload(q, self._payload, rows["gravity"])
            self._library.lipserve_coriolis_payload(q, dq, self._payload, rows["coriolis"])
            self._library.lipserve_mass_matrix_payload(q, self._payload, rows["inertia_matrix"])
            self._library.lipserve_friction(q, dq, ddq, self._payload, None, rows["friction"])
            if self._payload is None:
                self._assert_same_without_payload(q, dq, out, k)
        out["inertia_matrix"] = out["inertia_matrix"].reshape(count, n, n)
        return out

    def _assert_same_without_payload(self, q: ctypes.Array, dq: ctypes.Array, out: dict, k: int) -> None:
        alone = {name: np.full_like(out[name][k], np.nan) for name in ("gravity", "coriolis", "inertia_matrix")}
        self._library.lipserve_gravity(q, c_array(alone["gravity"]))
        self._library.lipserve_coriolis(q, dq, c_array(alone["coriolis"]))
        self._library.lipserve_mass_matrix(q, c_array(alone["inertia_matrix"]))
        for name, values in alone.items():
            np.testing.assert_array_equal(values, out[name][k])


@needs_compiler
@pytest.mark.parametrize("name", few(MODELS, kept=lambda name: name == "panda"))
def test_parts_are_the_components_of_the_model(name: str, tmp_path: Path) -> None:
    model = MODELS[name]()
    motion = draw_motions(model, 20, 1)
    q, dq, ddq = motion
    found = Parts(compile_library(c_files(model, ORIGIN), tmp_path), model.n_joints).of(motion)
    expected = dynamics.components(model, Motion(q, 0 * q, 0 * q), ["gravity", "inertia_matrix"])
    expected |= dynamics.components(model, Motion(q, dq, ddq), ["coriolis", "friction"])
    for part, values in found.items():
        mean = expected[part].mean
        np.testing.assert_allclose(values, mean, rtol=1e-9, atol=1e-11 * np.abs(q).max() * np.abs(mean).max() + 1e-12)
        assert np.abs(mean).max() > 1e-3, part


@needs_compiler
@pytest.mark.parametrize("name", few(MODELS, kept=lambda name: name == "panda"))
def test_torque_without_gravity_has_the_std_of_the_difference(name: str, tmp_path: Path) -> None:
    model, body = MODELS[name](), BODY
    path, motion = compile_library(c_files(model, ORIGIN), tmp_path), draw_motions(model, 20, 1)
    carried = Carrier(model)
    for asked, payload in ((model, None), (carried.with_payload(carried.known(body.parameters)), body)):
        expected = dynamics.components(asked, Motion(*motion), ["without_gravity"])["without_gravity"]
        carrying = None if payload is None else ctypes.byref(c_payload(payload))
        tau, std = np.full((2, *motion.shape[1:]), np.nan)
        for k in range(motion.shape[1]):
            query = [c_array(np.ascontiguousarray(part[k])) for part in motion]
            arguments = (*query, carrying, None, c_array(tau[k]), c_array(std[k]))
            ctypes.CDLL(str(path)).lipserve_torque_without_gravity(*arguments)
        np.testing.assert_allclose(tau, expected.mean, rtol=1e-8, atol=1e-10 * np.abs(motion).max())
        if "energies" in name:
            assert np.isnan(std).all()
        else:
            np.testing.assert_allclose(std, expected.std, rtol=1e-5)


@needs_compiler
@pytest.mark.parametrize("kinds", ["RPR", slow("RRRRRR")])
def test_parts_are_those_of_pinocchio(kinds: str, tmp_path: Path) -> None:
    """A model with the weights of a known robot: bodies, rotors and a payload at its last joint."""
    geometry, bodies, robot = arm(kinds, 50)
    samples, n = record_motion(robot, 1, 60), len(kinds)
    rotor = 0.1 * np.arange(1.0, n + 1)
    model = train_from_geometry(geometry, robot, samples, OPTIONS)
    assert model.arm is not None
    none, fixed = np.zeros(0), replace(model.arm, geometry=geometry, parameters=bodies, centre=bodies, rotor=rotor)
    fixed = replace(fixed, mode="fixed", expected=none, widths=none)
    chosen = make_estimator("rigid-body", model.joint_types, arm=fixed)
    before, once = model.posterior, np.broadcast_to(model.posterior.noise_variance, samples.tau.shape)
    posterior = build_linear(chosen.kernel, before.params, samples, once, 0.01, 1.0, before.misfit).posterior
    posterior = replace(posterior, weights=np.zeros_like(posterior.weights))
    model = replace(model, estimator=chosen, posterior=posterior)
    path, motion = compile_library(c_files(model, ORIGIN), tmp_path), draw_motions(model, 20, 1)
    for body in (None, BODY):
        carried = bodies.copy()
        if body is not None:
            carried[-1] += body.parameters
        exact = as_robot(geometry, carried).model
        exact.armature = rotor
        data, found = exact.createData(), Parts(path, n, body).of(motion)
        for k, (q, dq, _) in enumerate(motion.transpose(1, 0, 2)):
            gravity = pin.computeGeneralizedGravity(exact, data, q).copy()
            upper = np.triu(pin.crba(exact, data, q))
            close = partial(np.testing.assert_allclose, rtol=1e-9, atol=1e-9)
            close(found["gravity"][k], gravity)
            close(found["coriolis"][k], pin.nonLinearEffects(exact, data, q, dq) - gravity)
            close(found["inertia_matrix"][k], upper + np.triu(upper, 1).T)


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("name", ["panda", "energies"])
def test_parts_of_an_arm_with_a_payload_add_up(name: str, tmp_path: Path) -> None:
    model = MODELS[name]()
    path, motion = compile_library(c_files(model, ORIGIN), tmp_path), draw_motions(model, 20, 1)
    without, found = Parts(path, model.n_joints).of(motion), Parts(path, model.n_joints, BODY).of(motion)
    tau, _ = evaluate_library(path, motion, BODY)
    inertial = (found["inertia_matrix"] @ motion[2][..., None])[..., 0]
    total = inertial + found["coriolis"] + found["gravity"] + found["friction"]
    np.testing.assert_allclose(total, tau, rtol=1e-9, atol=1e-9 * np.abs(tau).max())
    assert (np.abs(found["gravity"] - without["gravity"]).max(axis=0)[1:] > 1e-3).all()


@needs_compiler
def test_state_is_unknown_after_a_number_that_is_not_finite(tmp_path: Path) -> None:
    model = MODELS["play, from its tip"]()
    state = CompiledState(compile_library(c_files(model, ORIGIN), tmp_path), 2)
    query = np.array([[0.1, 0.2], [1e-3, -1e-3], [0.0, 0.0]])
    without = state.evaluate(query, is_used=False)
    np.testing.assert_array_equal(state.evaluate(query), without)
    state.update(query[0], query[1], 0.001)
    first = state.evaluate(query)
    np.testing.assert_array_equal(first, without)  # the instant alone is more certain
    for place, wrong in product((0, 1), (np.nan, np.inf)):
        state.update(query[0] + 0.05, query[1], 0.001)
        assert (state.evaluate(query)[1] < first[1]).all()
        broken = query[:2].copy()
        broken[place, 1] = wrong
        state.update(*broken, 0.001)
        np.testing.assert_array_equal(state.evaluate(query), without)
        state.update(query[0], query[1], 0.001)
        np.testing.assert_array_equal(state.evaluate(query), first)


@needs_compiler
def test_models_without_play_ignore_the_state(tmp_path: Path) -> None:
    model = load(PANDA)
    state = CompiledState(compile_library(c_files(model, ORIGIN), tmp_path), 7)
    query = np.ascontiguousarray(draw_motions(model, 1, 1)[:, 0])
    for step in (0.0, 0.01):
        state.update(query[0] + step, query[1], 0.001)
        np.testing.assert_array_equal(state.evaluate(query), state.evaluate(query, is_used=False))
    assert not any(state.numbers)


@needs_compiler
@pytest.mark.parametrize(
    "name",
    [
        "panda",
        *map(slow, ("prismatic", "alternatives", "fixed, from its tip", "energies", "local", "friction of all kinds")),
        slow("friction of all kinds, alternatives"),
    ],
)
@pytest.mark.parametrize("body", [BODY, Body(0.7, np.array([0.1, 0.2, -0.3]))], ids=["body", "point"])
def test_compiled_payload_matches_a_declared_payload(name: str, body: Body, tmp_path: Path) -> None:
    model = MODELS[name]()
    motion, carrier = draw_motions(model, 300, 1), Carrier(model)
    expected, tau_std, *_ = carrier.with_payload(carrier.known(body.parameters)).evaluator.many(*motion)
    tau, std = evaluate_library(compile_library(c_files(model, ORIGIN), tmp_path), motion, body)
    np.testing.assert_allclose(tau, expected, rtol=1e-9, atol=1e-10 * np.abs(expected).max())
    np.testing.assert_allclose(std, tau_std, rtol=1e-7)
    empty, _ = evaluate_library(tmp_path / "model.so", motion, replace(body, mass=1e-300, inertia=None))
    np.testing.assert_array_equal(empty, evaluate_library(tmp_path / "model.so", motion)[0])


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(
    ("name", "between", "change"),
    [
        ("panda", ("double DRIVE", "double MISFIT"), 1e-5),
        ("panda", ("void write_torque", "void write_features"), 1e-5),
        ("panda", ("void write_features", "void read_payload"), 1e-2),
        ("energies of a prismatic joint", ("double CONSTANT", "int PLACE"), 1e-5),
    ],
)
def test_self_test_detects_a_changed_number(name: str, between: tuple[str, str], change: float, tmp_path: Path) -> None:
    files = c_files(MODELS[name](), ORIGIN)
    text = files[SOURCE]
    first, last = map(text.index, between)
    found = [each.span() for each in re.compile(r"-?\d+\.\d{12,}(e-?\d+)?").finditer(text, first, last)]
    large = [span for span in found if abs(float(text[slice(*span)])) > 0.05]
    for start, end in np.random.default_rng(0).choice(large, 8, replace=False):
        wrong = repr(float(text[start:end]) * (1 + change))
        path = compile_library({**files, SOURCE: text[:start] + wrong + text[end:]}, tmp_path / str(start))
        assert ctypes.CDLL(str(path)).lipserve_selftest() > 0, text[start:end]


@pytest.mark.slow
@needs_compiler
def test_self_test_detects_a_changed_state(tmp_path: Path) -> None:
    files = c_files(MODELS["friction of all kinds"](), ORIGIN)
    text = files[SOURCE]
    changes = {
        "lower[e][k] + step": "lower[e][k] - step",
        "upper[e][k] + step": "upper[e][k]",
        "0.5 * (state->lower": "0.501 * (state->lower",
        "0.001, 0.001, 0.001}": "0.001, 0.00101, 0.001}",
    }
    for k, (right, wrong) in enumerate(changes.items()):
        assert right in text
        path = compile_library({**files, SOURCE: text.replace(right, wrong, 1)}, tmp_path / str(k))
        assert ctypes.CDLL(str(path)).lipserve_selftest() > 0, wrong


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(
    "make",
    [train_with_alternatives, lambda: train_with_energies("RPR", 51), train_with_alternatives_and_drive],
    ids=["alternatives", "energies", "friction"],
)
def test_code_has_no_mutable_state(make: Callable[[], TorqueModel], tmp_path: Path) -> None:
    """The object has no writable data and calls only five functions of libm."""
    write_files(c_files(make(), ORIGIN), tmp_path)
    run(tmp_path, "cc", *FLAGS, "-c", SOURCE, "-o", "model.o")
    kinds = {line.split()[-1]: line.split()[-2] for line in run(tmp_path, "nm", "model.o").splitlines()}
    called = {name for name, kind in kinds.items() if kind == "U"}
    by_compilers = {"memcpy", "memmove", "memset", "sincos", "_GLOBAL_OFFSET_TABLE_", "__stack_chk_fail"}
    assert called - by_compilers <= {"sin", "cos", "sqrt", "exp", "tanh"}
    assert set(kinds.values()) <= set("TtRrU"), kinds


MAIN = '#include "lipserve_model.h"\nint main(void) { return lipserve_selftest(); }\n'


@pytest.mark.slow
@pytest.mark.parametrize("compiler", ["gcc", slow("clang")])
@pytest.mark.parametrize(
    "name",
    ["panda", *map(slow, ("alternatives", "friction of all kinds, alternatives", "energies of a prismatic joint"))],
)
def test_compilers_and_sanitizers_report_nothing(name: str, compiler: str, tmp_path: Path) -> None:
    if shutil.which(compiler) is None:
        pytest.skip(f"needs {compiler}, which is not installed")
    write_files({"main.c": MAIN, **c_files(MODELS[name](), ORIGIN)}, tmp_path)
    sanitized = sanitizers(compiler)
    for more in ((), (*sanitized, "-O1")) if sanitized else ((),):
        run(tmp_path, compiler, *FLAGS, *more, "main.c", SOURCE, "-o", "main", "-lm")
        run(tmp_path, "./main")


@needs_compiler
def test_threads_do_not_disturb_each_other(tmp_path: Path) -> None:
    model = load(PANDA)
    path = compile_library(c_files(model, ORIGIN), tmp_path)
    motions = [draw_motions(model, 2000, seed) for seed in (1, 2)]
    alone = [evaluate_library(path, motion) for motion in motions]
    with ThreadPoolExecutor() as threads:
        together = list(threads.map(partial(evaluate_library, path), motions))
    np.testing.assert_array_equal(alone, together)


@needs_compiler
def test_interval_and_training_range(tmp_path: Path) -> None:
    model = load(PANDA)
    library = ctypes.CDLL(str(compile_library(c_files(model, ORIGIN), tmp_path)))
    motion = draw_motions(model, 2, 1)
    std, half = np.full(7, 0.02), np.zeros(7)
    library.lipserve_interval(c_array(std), c_array(half))
    expected = 1.959963984540054 * model.scale * np.sqrt(std**2 + model.noise_std**2)
    np.testing.assert_allclose(half, expected, rtol=1e-12)
    assert library.lipserve_in_range(*[c_array(part[0]) for part in motion]) == 1
    for part, name in enumerate(("q", "dq", "ddq")):
        for joint, value in ((0, model.training_range[name]["max"][0] + 1e-6), (6, np.nan)):
            far = motion[:, 0].copy()
            far[part, joint] = value
            assert library.lipserve_in_range(*[c_array(row) for row in far]) == 0


@pytest.mark.slow
def test_names_cannot_end_comments_or_strings(tmp_path: Path) -> None:
    names = ("*/ int x; /*", '", 0}; int y; //', "gelenk ü\\\n?/")
    model = replace(train_arm("RRR", 50), joint_names=names)
    files = c_files(model, ModelOrigin('*/"\\', 1, 0, "*/"))
    assert all(text.isascii() for text in files.values())
    code = re.sub(r'/\*.*?\*/|"(\\.|[^"\\\n])*"', "", files[HEADER] + files[SOURCE], flags=re.DOTALL)
    assert "int x" not in code
    assert "int y" not in code
    if shutil.which("cc") is None:
        return
    library = ctypes.CDLL(str(compile_library(files, tmp_path)))
    size = max(len(name.encode()) for name in names) + 1
    stored = (ctypes.c_char * (3 * size)).in_dll(library, "lipserve_joint_names").raw
    assert [stored[k * size : (k + 1) * size].rstrip(b"\0").decode() for k in range(3)] == list(names)


def test_other_estimators_are_rejected() -> None:
    _, _, robot = arm("RRR", 50)
    few = FitOptions(device="cpu", hyperparameter_samples=20, max_iterations=2, starts=1)
    model = train(record_motion(robot, 1, 40), robot.joint_types, "lip-chain", few)
    with pytest.raises(
        UnsupportedEstimatorError, match=r"'lip-chain', expected one of rigid-body, .*rigid-body\+lip-chain for C"
    ):
        c_files(model, ORIGIN)


@pytest.mark.slow
@needs_compiler
@pytest.mark.skipif(shutil.which("c++") is None, reason="needs a C++ compiler, c++, which is not installed")
def test_example_controller_uses_the_code(tmp_path: Path) -> None:
    model = load(PANDA)
    write_files(c_files(model, ORIGIN), tmp_path)
    run(tmp_path, "cc", *FLAGS, "-c", SOURCE)
    strict = ("-std=c++17", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2", "-I.")
    example = ROOT / "docs/examples/feedforward_controller.cpp"
    run(tmp_path, "c++", *strict, str(example), "lipserve_model.o", "-o", "controller")
    limits = np.array([model.training_range["q"][end] for end in ("min", "max")])
    for middle, used in ((limits.mean(0), 20), (limits[1] + 1.0, 0)):
        printed = run(tmp_path, "./controller", "20", *map(str, middle))
        assert printed.startswith(f"used {used} of 20, the longest cycle took")
