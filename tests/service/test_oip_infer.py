"""Inference in JSON: the answers are lipcore's own, and only what is named is computed."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lipcore.data.motion import Motion
from lipcore.model import dynamics
from lipcore.model.torque_model import TorqueModel
from service.oip import answer as answering
from service.oip import wire
from service.oip.query import PARTS
from tests.service.data import service_of
from tests.service.oip import ask, listed, message, tensors

EXACT = {"rtol": 1e-9, "atol": 1e-12}
TORQUES = {"tau_gravity": "gravity", "tau_coriolis": "coriolis", "tau_inertial": "inertial", "tau_friction": "friction"}
MATRIX, ENERGIES = "inertia_matrix", ("kinetic_energy", "potential_energy")


@pytest.fixture(scope="module")
def motion(trained):
    """Five instants of training."""
    return {name: getattr(trained.samples, name)[10:60:10] for name in ("q", "dq", "ddq")}


def first(motion):
    return {name: values[0] for name, values in motion.items()}


def test_a_batch_is_answered_as_lipcore_does(api, trained, motion):
    answer = ask(api, trained.name, message(motion, "tau", "tau_std", "noise_std", "covariance", id="7"))
    found, expected = tensors(answer), trained.model.predict(**motion, covariance=True)
    assert {name: value for name, value in answer.items() if name != "outputs"} == {
        "id": "7",
        "model_name": trained.name,
        "model_version": "1",
        "parameters": {"revision": 0, "torque_convention": "gravity_included"},
    }
    assert list(found) == ["tau", "tau_std", "noise_std", "covariance"]
    assert {name: values.shape for name, values in found.items()} == {
        "tau": (5, 2),
        "tau_std": (5, 2),
        "noise_std": (2,),
        "covariance": (5, 2, 2),
    }
    for name, values in found.items():
        assert_allclose(values, getattr(expected, name), **EXACT)


@pytest.mark.parametrize("names", [["tau"], ["noise_std"], ["tau_std", "tau"]])
@pytest.mark.parametrize("rows", [None, 1, 3])
def test_outputs_are_answered_in_the_order_of_the_request_and_shaped_as_it(api, trained, motion, names, rows):
    query = first(motion) if rows is None else {name: values[:rows] for name, values in motion.items()}
    found = tensors(ask(api, trained.name, message(query, *names)))
    assert list(found) == names
    expected = trained.model.predict(**query)
    for name, values in found.items():
        assert values.shape == ((2,) if rows is None or name == "noise_std" else (rows, 2))
        assert_allclose(np.atleast_2d(values), np.atleast_2d(getattr(expected, name)), **EXACT)


@pytest.mark.parametrize("absent", [{}, {"outputs": []}, {"outputs": None}])
def test_torque_and_its_deviation_are_the_default(api, trained, motion, absent):
    found = tensors(ask(api, trained.name, message(motion) | absent))
    assert list(found) == ["tau", "tau_std"]
    assert_allclose(found["tau"], trained.model.predict(**motion).tau, **EXACT)


def component(name):
    plain = name.removesuffix("_std")
    return TORQUES.get(plain, plain), "std" if name.endswith("_std") else "mean"


@pytest.mark.parametrize("name", [name for name in PARTS if not name.startswith("forward")])
@pytest.mark.parametrize("rows", [None, 5])
def test_components_are_those_of_lipcore(api, trained, motion, name, rows):
    query = first(motion) if rows is None else motion
    found = tensors(ask(api, trained.name, message(query, name)))[name]
    inner, kind = component(name)
    estimate = dynamics.components(trained.model, Motion.from_arrays(**query), [inner])[inner]
    expected = getattr(estimate, kind).numpy()
    each = (1,) if inner in ENERGIES else (2, 2) if inner == MATRIX else (2,)
    assert found.shape == (each if rows is None else (5, *each))
    assert_allclose(found.ravel(), expected.ravel(), rtol=1e-6, atol=1e-9 * float(np.abs(expected).max()))


def test_forward_dynamics_of_one_query(api, trained, motion):
    query = first(motion) | {"tau": np.array([1.0, -0.5])}
    found = tensors(ask(api, trained.name, message(query, "forward_dynamics", "forward_dynamics_std")))
    tau = Motion.from_arrays(**first(motion)).q.new_tensor([[1.0, -0.5]])
    expected = dynamics.forward_dynamics(trained.model, Motion.from_arrays(**first(motion)), tau)
    assert_allclose(found["forward_dynamics"], expected.mean[0], rtol=1e-6)
    assert_allclose(found["forward_dynamics_std"], expected.std[0], rtol=1e-5)


@pytest.mark.parametrize(
    ("names", "rows", "called"),
    [
        (["tau", "noise_std"], None, [("answer", False)]),
        (["tau"], 3, [("answer", False)] * 3),
        ([], None, [("answer", True)]),
        (["tau", "tau_std"], 1, [("answer", True)]),
        (["tau_std"], 2, [("predict", False)]),
        (["covariance"], None, [("predict", True)]),
        (["noise_std"], 2, []),
        (["tau_gravity_std", "tau_gravity"], 2, [("components", ["gravity"])]),
        (["inertia_matrix", "tau"], None, [("answer", False), ("components", ["inertia_matrix"])]),
    ],
)
def test_nothing_is_computed_that_is_not_asked_for(api, trained, motion, monkeypatch, names, rows, called):
    seen = []

    def noting(owner, name, what):
        function = getattr(owner, name)

        def noted(*arguments, **more):
            seen.append((name, what(*arguments, **more)))
            return function(*arguments, **more)

        monkeypatch.setattr(owner, name, noted)

    noting(TorqueModel, "answer", lambda model, motion, std=True: std)
    noting(TorqueModel, "predict", lambda model, q, dq, ddq, covariance=False: covariance)
    noting(dynamics, "components", lambda model, motion, names, tau=None: list(names))
    query = first(motion) if rows is None else {name: values[:rows] for name, values in motion.items()}
    ask(api, trained.name, message(query, *names))
    assert seen == called


@pytest.mark.parametrize(
    ("names", "rows", "what", "here"),
    [
        (["tau", "tau_std"], None, (answering, "compute"), True),
        (["tau"], 1, (answering, "compute"), True),
        (["tau"], 2, (answering, "compute"), False),
        (["tau", "covariance"], None, (answering, "compute"), False),
        (["tau_std"], 500, (wire, "decode"), False),
    ],
)
def test_single_queries_run_on_the_event_loop_and_all_else_in_threads(
    api, trained, motion, monkeypatch, names, rows, what, here
):
    loop, function, seen = api.portal.call(threading.get_ident), getattr(*what), []

    def noted(*arguments):
        seen.append(threading.get_ident())
        return function(*arguments)

    monkeypatch.setattr(*what, noted)
    many = {name: np.tile(values, (100, 1)) for name, values in motion.items()}
    ask(
        api,
        trained.name,
        message({name: values[:rows] if rows else values[0] for name, values in many.items()}, *names),
    )
    assert [thread == loop for thread in seen] == [here]


def test_data_may_be_nested(api, trained, motion):
    nested = message(motion, "tau")
    for tensor, values in zip(nested["inputs"], motion.values(), strict=True):
        tensor["data"] = values.tolist()
    assert ask(api, trained.name, nested) == ask(api, trained.name, message(motion, "tau"))


def test_single_precision_is_rounded_as_it_says(api, trained, motion):
    """0.1 of FP32 is another number than 0.1 of FP64."""
    single = {"inputs": [listed(name, values, "FP32") for name, values in motion.items()]}
    rounded = {name: values.astype(np.float32).astype(np.float64) for name, values in motion.items()}
    found = tensors(ask(api, trained.name, single))
    assert_array_equal(found["tau"], tensors(ask(api, trained.name, message(rounded)))["tau"])
    assert np.abs(found["tau"] - tensors(ask(api, trained.name, message(motion)))["tau"]).max() > 0


def test_parameters_that_are_not_known_are_ignored(api, trained, motion):
    """As the protocol has it: clients of other servers send them."""
    plain = message(motion, "tau")
    more = plain | {"parameters": {"sequence_id": 3, "content_type": "np", "binary_data_output": None}}
    more["inputs"] = [each | {"parameters": {"content_type": "np"}} for each in plain["inputs"]]
    more["outputs"] = [each | {"parameters": {"content_type": "np"}} for each in plain["outputs"]]
    assert ask(api, trained.name, more) == ask(api, trained.name, plain)


@pytest.mark.parametrize("name", ["", 'Ünïcode \u2028 \U0001f916 "\\\n', "x" * 5000])
def test_the_id_is_returned_as_it_is(api, trained, motion, name):
    assert ask(api, trained.name, message(first(motion), id=name))["id"] == name
    assert "id" not in ask(api, trained.name, message(first(motion), id=None))


def test_the_revision_is_that_of_the_version_that_answers(api, trained, motion, monkeypatch):
    served = replace(service_of(api).loaded.get(trained.name, 1), revision=17)
    monkeypatch.setattr(service_of(api).loaded, "hot", lambda *_: served)
    assert ask(api, trained.name, message(motion))["parameters"]["revision"] == 17
