"""Inference in JSON: answers equal lipcore's, and only the requested outputs are computed."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lipcore.data.motion import Motion
from lipcore.model import dynamics
from service.api.oip.query import COMPONENT_TENSORS
from tests.service.api.oip.requests import infer, json_input, message, tensors
from tests.service.data import service_of

EXACT = {"rtol": 1e-9, "atol": 1e-12}
TORQUES = {f"tau_{part}": part for part in ("gravity", "coriolis", "inertial", "friction", "without_gravity")}
MATRIX, ENERGIES = "inertia_matrix", ("kinetic_energy", "potential_energy")


@pytest.fixture(scope="module")
def motion(trained):
    """Five states of the training data."""
    return {name: getattr(trained.samples, name)[10:60:10] for name in ("q", "dq", "ddq")}


def first(motion):
    return {name: values[0] for name, values in motion.items()}


def test_batch_is_answered_as_by_lipcore(api, trained, motion):
    answer = infer(api, trained.name, message(motion, "tau", "tau_std", "noise_std", "covariance", id="7"))
    result, expected = tensors(answer), trained.model.predict(**motion, covariance=True)
    assert {name: value for name, value in answer.items() if name != "outputs"} == {
        "id": "7",
        "model_name": trained.name,
        "model_version": "1",
        "parameters": {"revision": 0, "torque_convention": "gravity_included"},
    }
    assert list(result) == ["tau", "tau_std", "noise_std", "covariance"]
    for name, values in result.items():
        assert_allclose(values, getattr(expected, name), **EXACT)


@pytest.mark.parametrize("names", [["tau"], ["noise_std"], ["tau_std", "tau"]])
@pytest.mark.parametrize("rows", [None, 1, 3])
def test_outputs_have_the_order_and_shape_of_the_request(api, trained, motion, names, rows):
    query = first(motion) if rows is None else {name: values[:rows] for name, values in motion.items()}
    result = tensors(infer(api, trained.name, message(query, *names)))
    assert list(result) == names
    expected = trained.model.predict(**query)
    for name, values in result.items():
        assert values.shape == ((2,) if rows is None or name == "noise_std" else (rows, 2))
        assert_allclose(np.atleast_2d(values), np.atleast_2d(getattr(expected, name)), **EXACT)


def component(name):
    plain = name.removesuffix("_std")
    return TORQUES.get(plain, plain), "std" if name.endswith("_std") else "mean"


@pytest.mark.parametrize("name", [name for name in COMPONENT_TENSORS if not name.startswith("forward")])
@pytest.mark.parametrize("rows", [None, 5])
def test_components_equal_lipcore(api, trained, motion, name, rows):
    query = first(motion) if rows is None else motion
    result = tensors(infer(api, trained.name, message(query, name)))[name]
    inner, kind = component(name)
    estimate = dynamics.components(trained.model, Motion.from_arrays(**query), [inner])[inner]
    expected = getattr(estimate, kind)
    each = (1,) if inner in ENERGIES else (2, 2) if inner == MATRIX else (2,)
    assert result.shape == (each if rows is None else (5, *each))
    assert_allclose(result.ravel(), expected.ravel(), rtol=1e-6, atol=1e-9 * float(np.abs(expected).max()))


def test_forward_dynamics_of_one_query(api, trained, motion):
    query = first(motion) | {"tau": np.array([1.0, -0.5])}
    result = tensors(infer(api, trained.name, message(query, "forward_dynamics", "forward_dynamics_std")))
    tau = np.array([[1.0, -0.5]])
    expected = dynamics.forward_dynamics(trained.model, Motion.from_arrays(**first(motion)), tau)
    assert_allclose(result["forward_dynamics"], expected.mean[0], rtol=1e-6)
    assert_allclose(result["forward_dynamics_std"], expected.std[0], rtol=1e-5)


def test_fp32_rounds_as_documented(api, trained, motion):
    """0.1 in FP32 differs from 0.1 in FP64."""
    single = {"inputs": [json_input(name, values, "FP32") for name, values in motion.items()]}
    rounded = {name: values.astype(np.float32).astype(np.float64) for name, values in motion.items()}
    result = tensors(infer(api, trained.name, single))
    assert_array_equal(result["tau"], tensors(infer(api, trained.name, message(rounded)))["tau"])
    assert np.abs(result["tau"] - tensors(infer(api, trained.name, message(motion)))["tau"]).max() > 0


def test_answer_names_the_serving_revision(api, trained, motion, monkeypatch):
    served = replace(service_of(api).loaded.get(trained.name, 1), revision=17)
    monkeypatch.setattr(service_of(api).loaded, "hot", lambda *_: served)
    assert infer(api, trained.name, message(motion))["parameters"]["revision"] == 17
