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
from service.oip import query as querying
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


def test_one_query_is_answered_as_its_row_of_a_batch(api, trained, motion):
    names = ("tau", "tau_std", "covariance", "noise_std")
    batch = tensors(ask(api, trained.name, message(motion, *names)))
    for row in range(5):
        alone = {name: values[row] for name, values in motion.items()}
        found = tensors(ask(api, trained.name, message(alone, *names)))
        for name in names:
            assert_allclose(found[name], batch[name] if name == "noise_std" else batch[name][row], **EXACT)


@pytest.mark.parametrize("names", [["tau"], ["tau_std"], ["noise_std"], ["tau_std", "tau"], ["noise_std", "tau"]])
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


def test_every_output_at_once(api, trained, motion):
    names = [*querying.shapes(trained.model)]
    tau = trained.model.predict(**motion).tau
    found = tensors(ask(api, trained.name, message({**motion, "tau": tau}, *names)))
    assert list(found) == names
    total = sum(found[name] for name in TORQUES)
    assert_allclose(total, found["tau"], atol=1e-9)
    assert_allclose(found["forward_dynamics"], motion["ddq"], atol=1e-6 * np.abs(motion["ddq"]).max())


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
        (["tau"], None, [("answer", False)]),
        (["tau", "noise_std"], None, [("answer", False)]),
        (["tau"], 3, [("answer", False)] * 3),
        (["tau_std"], None, [("answer", True)]),
        ([], None, [("answer", True)]),
        (["tau", "tau_std"], 1, [("answer", True)]),
        (["tau_std"], 2, [("predict", False)]),
        (["covariance"], None, [("predict", True)]),
        (["noise_std"], 2, []),
        (["tau_gravity"], None, [("components", ["gravity"])]),
        (["tau_gravity_std", "tau_gravity"], 2, [("components", ["gravity"])]),
        (["inertia_matrix", "tau"], None, [("answer", False), ("components", ["inertia_matrix"])]),
    ],
)
def test_nothing_is_computed_that_is_not_asked_for(api, trained, motion, monkeypatch, names, rows, called):
    seen = []
    answer, predict, components = TorqueModel.answer, TorqueModel.predict, dynamics.components

    def answering(self, motion, std=True):
        seen.append(("answer", std))
        return answer(self, motion, std)

    def predicting(self, q, dq, ddq, covariance=False):
        seen.append(("predict", covariance))
        return predict(self, q, dq, ddq, covariance)

    def composing(model, motion, names, tau=None):
        seen.append(("components", list(names)))
        return components(model, motion, names, tau)

    monkeypatch.setattr(TorqueModel, "answer", answering)
    monkeypatch.setattr(TorqueModel, "predict", predicting)
    monkeypatch.setattr(dynamics, "components", composing)
    query = first(motion) if rows is None else {name: values[:rows] for name, values in motion.items()}
    ask(api, trained.name, message(query, *names))
    assert seen == called


@pytest.mark.parametrize(
    ("names", "rows", "here"),
    [(["tau", "tau_std"], None, True), (["tau"], 1, True), (["tau"], 2, False), (["tau", "covariance"], None, False)],
)
def test_single_queries_run_on_the_event_loop_and_all_else_in_threads(
    api, trained, motion, monkeypatch, names, rows, here
):
    loop, compute, seen = api.portal.call(threading.get_ident), querying.compute, []

    def computing(*arguments):
        seen.append(threading.get_ident())
        return compute(*arguments)

    monkeypatch.setattr(querying, "compute", computing)
    query = first(motion) if rows is None else {name: values[:rows] for name, values in motion.items()}
    ask(api, trained.name, message(query, *names))
    assert [thread == loop for thread in seen] == [here]


def test_large_bodies_are_decoded_in_threads(api, trained, motion, monkeypatch):
    loop, seen = api.portal.call(threading.get_ident), []
    decode = wire.decode

    def decoding(*arguments):
        seen.append(threading.get_ident())
        return decode(*arguments)

    monkeypatch.setattr(wire, "decode", decoding)
    many = {name: np.tile(values, (100, 1)) for name, values in motion.items()}
    found = tensors(ask(api, trained.name, message(many, "tau_std")))["tau_std"]
    assert found.shape == (500, 2)
    assert [thread == loop for thread in seen] == [False]


def test_the_order_of_the_inputs_does_not_matter(api, trained, motion):
    turned = dict(reversed(motion.items()))
    assert ask(api, trained.name, message(turned, "tau")) == ask(api, trained.name, message(motion, "tau"))


def test_data_may_be_nested(api, trained, motion):
    nested = message(motion, "tau")
    for tensor, values in zip(nested["inputs"], motion.values(), strict=True):
        tensor["data"] = values.tolist()
    assert ask(api, trained.name, nested) == ask(api, trained.name, message(motion, "tau"))


def test_whole_numbers_are_numbers(api, trained):
    whole = {"q": [1, 0], "dq": [0, 2], "ddq": [-1, 0]}
    inputs = [{"name": name, "shape": [2], "datatype": "FP64", "data": data} for name, data in whole.items()]
    assert ask(api, trained.name, {"inputs": inputs}) == ask(api, trained.name, message(whole))


def test_single_precision_is_rounded_as_it_says(api, trained, motion):
    """0.1 of FP32 is another number than 0.1 of FP64."""
    single = {"inputs": [listed(name, values, "FP32") for name, values in motion.items()]}
    rounded = {name: values.astype(np.float32).astype(np.float64) for name, values in motion.items()}
    found = tensors(ask(api, trained.name, single))
    assert_array_equal(found["tau"], tensors(ask(api, trained.name, message(rounded)))["tau"])
    assert np.abs(found["tau"] - tensors(ask(api, trained.name, message(motion)))["tau"]).max() > 0


def test_datatypes_may_differ_between_inputs(api, trained, motion):
    mixed = message(motion)
    mixed["inputs"][1]["datatype"] = "FP32"
    rounded = motion | {"dq": motion["dq"].astype(np.float32).astype(np.float64)}
    assert ask(api, trained.name, mixed) == ask(api, trained.name, message(rounded))


@pytest.mark.parametrize("named", [{}, {"model_name": "pendulum"}, {"model_name": "pendulum", "model_version": "1"}])
def test_a_version_may_be_named(api, trained, motion, named):
    asked = message(motion, "tau", **named)
    assert ask(api, trained.name, asked, version=1) == ask(api, trained.name, asked)


def test_parameters_that_are_not_known_are_ignored(api, trained, motion):
    """As the protocol has it: clients of other servers send them."""
    plain = message(motion, "tau")
    more = plain | {"parameters": {"sequence_id": 3, "content_type": "np", "binary_data_output": None}}
    more["inputs"] = [each | {"parameters": {"content_type": "np"}} for each in plain["inputs"]]
    more["outputs"] = [each | {"parameters": {"content_type": "np"}} for each in plain["outputs"]]
    assert ask(api, trained.name, more) == ask(api, trained.name, plain)


@pytest.mark.parametrize("name", ["", "42", "Ünïcode \u2028 \U0001f916", "x" * 5000, '"\\\n'])
def test_the_id_is_returned_as_it_is(api, trained, motion, name):
    assert ask(api, trained.name, message(first(motion), id=name))["id"] == name
    assert "id" not in ask(api, trained.name, message(first(motion), id=None))


def test_the_revision_is_that_of_the_version_that_answers(api, trained, motion, monkeypatch):
    served = replace(service_of(api).loaded.get(trained.name, 1), revision=17)
    monkeypatch.setattr(service_of(api).loaded, "hot", lambda *_: served)
    assert ask(api, trained.name, message(motion))["parameters"]["revision"] == 17
