"""Tests of parts of the torque by exported C: gravity, Coriolis, inertia, friction, and torque without gravity."""

import ctypes
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from lipcore.data.motion import Motion
from lipcore.estimators.catalogue import make_estimator
from lipcore.export.c_writer import c_files
from lipcore.model import dynamics
from lipcore.model.body import Body
from lipcore.model.payload import Carrier
from lipcore.model.torque_model import TorqueModel
from lipcore.posterior.compression import build_linear
from tests.choosing import few, slow
from tests.lipcore.arm_oracles import (
    arm,
    as_robot,
    record_motion,
    train_from_geometry,
)
from tests.lipcore.export.compiled import (
    c_array,
    c_payload,
    compile_library,
    evaluate_library,
    needs_compiler,
)
from tests.lipcore.export.models import (
    BODY,
    MODELS,
    OPTIONS,
    ORIGIN,
    draw_motions,
)


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
    cases: list[tuple[TorqueModel, Body | None]] = [(model, None)]
    if model.arms == 1:
        carried = Carrier(model)
        cases.append((carried.with_payload(carried.known(body.parameters)), body))
    for asked, payload in cases:
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
