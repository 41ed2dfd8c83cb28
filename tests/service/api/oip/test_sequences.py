"""Sequences of the Open Inference Protocol: friction that remembers follows their queries from request to request."""

import os
from dataclasses import replace
from threading import Thread

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lipcore import FitOptions, save
from lipcore.data.motion import Motion
from lipcore.kernels.drive.play import MAX_GAP_S, PlayState, element_widths
from lipcore.model import dynamics
from lipcore.robots.dirt import Dirt
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, simulate
from service.api.oip import dataplane, sequences
from service.api.oip.sequences import PLACES, SequencePart, Sequences, SharedStates
from service.foundation.errors import InvalidRequestError
from tests.lipcore.estimators.test_estimators import train_estimator
from tests.service.api.oip.requests import (
    binary_input,
    binary_tensors,
    error_message,
    infer,
    infer_binary,
    infer_path,
    message,
    pack_numbers,
    tensors,
)
from tests.service.data import service_of
from tests.service.models.archives.packing import exported, imported, pack, unpack, with_checksums

NAME, PERIOD_S, EXPORT = "remembering", 0.02, "export.json"
EXACT = {"rtol": 1e-9, "atol": 1e-12}
ID = "a whole number from 1 to 18446744073709551615, or a string of 1 to 128 characters"


@pytest.fixture(scope="module")
def model(api, trained, tmp_path_factory):
    """A model of the service with friction that remembers."""
    stream = Simulation(n_samples=1000, rate=50.0, speed=5.0, noise=0.0, dirt=Dirt(seed=5))
    options = FitOptions(hyperparameter_samples=40, posterior_samples=200, max_iterations=20, starts=1, device="cpu")
    made = train_estimator("rigid-body", simulate(load_robot("double-pendulum"), stream, 1), options)
    assert made.remembers
    folder = tmp_path_factory.mktemp("sequences") / "model"
    save(made, folder)
    files = {each.name: each.read_bytes() for each in folder.iterdir()}
    files[EXPORT] = unpack(exported(api, trained.name))[EXPORT]
    imported(api, pack(with_checksums(files)), name=NAME, promotion="always")
    return made


@pytest.fixture(autouse=True)
def clock(api, monkeypatch):
    """The time of arrival of the next request, s, in a service without sequences."""
    now = np.zeros(())
    monkeypatch.setattr(dataplane, "perf_counter", lambda: float(now))
    api.app.state.sequences = Sequences()
    return now


def slow_motion(rows):
    """Return a motion that turns back, with steps that its velocities explain."""
    t = PERIOD_S * np.arange(rows)[:, None]
    phase = np.array([0.0, 1.0])
    return {"q": 0.1 * np.sin(3 * t + phase), "dq": 0.3 * np.cos(3 * t + phase), "ddq": -0.9 * np.sin(3 * t + phase)}


def pick(motion, rows):
    return {name: values[rows] for name, values in motion.items()}


def expect(model, motion, times, **options):
    """Return lipcore's prediction along a motion that begins unknown, and its deflections."""
    widths = element_widths(model.joint_types)
    deflections, _ = PlayState.unknown(2).follow(np.array(times), motion["q"], motion["dq"], widths)
    return model.predict(**motion, deflections=deflections, **options), deflections


def ask(api, motion, *outputs, name=NAME, **parameters):
    return tensors(infer(api, name, message(motion, *outputs, parameters=parameters)))


def assert_equal(found, expected, row=slice(None)):
    for name in ("tau", "tau_std"):
        assert_allclose(found[name], getattr(expected, name)[row], **EXACT)


@pytest.mark.parametrize("sequence", [7, 2**64 - 1, "arm"])
def test_queries_of_a_sequence_are_answered_as_one_motion(api, model, clock, sequence):
    motion = slow_motion(60)
    expected, _ = expect(model, motion, PERIOD_S * np.arange(60))
    alone = model.predict(**motion)
    assert np.abs(expected.tau - alone.tau).max() > 1e-3
    for row in range(60):
        clock[...] = PERIOD_S * row
        found = ask(api, pick(motion, row), sequence_id=sequence, sequence_start=row == 0)
        assert_equal(found, expected, row)
    assert_equal(ask(api, pick(motion, 59)), alone, 59)


@pytest.mark.parametrize("outputs", [("tau",), ("tau", "tau_std"), ("tau", "covariance"), ("tau_friction", "tau")])
def test_rows_of_a_request_are_one_motion_at_its_arrival(api, model, clock, outputs):
    motion, times = slow_motion(60), np.repeat([0.0, 0.2], 30)
    expected, deflections = expect(model, motion, times, covariance=True)
    friction = dynamics.components(model, Motion(**motion, deflections=deflections), ["friction"])["friction"]
    for part in (slice(0, 30), slice(30, 60)):
        clock[...] = times[part][0]
        found = ask(api, pick(motion, part), *outputs, sequence_id=1)
        for name, values in found.items():
            entire = friction.mean if name == "tau_friction" else getattr(expected, name)
            assert_allclose(values, entire[part], rtol=1e-7, atol=1e-10)


def test_components_of_a_sequence_add_up(api, model):
    motion = slow_motion(60)
    names = ("tau_gravity", "tau_coriolis", "tau_inertial", "tau_friction")
    found = ask(api, motion, "tau", *names, sequence_id=1)
    assert_allclose(sum(found[name] for name in names), found["tau"], rtol=1e-6, atol=1e-8)
    torque = {**motion, "tau": found["tau"]}
    again = ask(api, torque, "forward_dynamics", "tau_external", sequence_id=1, sequence_start=True)
    assert_allclose(again["tau_external"], 0.0, atol=1e-12)
    alone = ask(api, torque, "forward_dynamics")["forward_dynamics"]
    error, error_alone = (np.abs(each - motion["ddq"]).max() for each in (again["forward_dynamics"], alone))
    assert error < 0.1 * error_alone


def test_large_binary_requests_follow_their_sequence(api, model, clock):
    motion = slow_motion(800)
    expected, _ = expect(model, motion, np.repeat([0.0, 0.1], 400))
    for part in (slice(0, 400), slice(400, 800)):
        clock[...] = 0.1 * (part.start > 0)
        values = pick(motion, part)
        parameters = {"sequence_id": 1, "binary_data_output": True}
        inputs = [binary_input(name, each) for name, each in values.items()]
        payload = b"".join(map(pack_numbers, values.values()))
        assert len(payload) > dataplane.MAX_INLINE_BYTES
        reply = infer_binary(api, NAME, {"inputs": inputs, "parameters": parameters}, payload)
        assert_equal(binary_tensors(reply)[1], expected, part)


def test_start_end_and_silence_make_the_motion_unknown(api, model, clock):
    motion = slow_motion(40)
    fresh = expect(model, pick(motion, slice(39, 40)), [0.0])[0]
    known = expect(model, motion, [0.0] * 40)[0]
    assert np.abs(known.tau - fresh.tau).max() > 1e-3

    def ends(first, pause=0.0, **second):
        """Return the torque at the last row, after the others in a request with other parameters."""
        clock[...] = 0.0
        ask(api, pick(motion, slice(0, 39)), sequence_id=5, **first)
        clock[...] = pause
        return ask(api, pick(motion, slice(39, 40)), **({"sequence_id": 5} | second))

    start, end = {"sequence_start": True}, {"sequence_end": True}
    assert_equal(ends(start), known, slice(39, 40))
    assert_equal(ends(start, **end), known, slice(39, 40))  # forgotten only after the answer
    for first, pause, second in (
        (start, 0.0, start),
        (start, 0.0, start | end),
        (start | end, 0.0, {}),
        (start, 1.01 * MAX_GAP_S, {}),
        (start, -0.01, {}),
        (start, 0.0, {"sequence_id": "5"}),
        (start, 0.0, {"sequence_id": 6}),
    ):
        assert_equal(ends(first, pause, **second), fresh, slice(0, 1))


def test_two_sequences_do_not_mix(api, model, clock):
    motions = {"a": slow_motion(30), "b": pick(slow_motion(60), slice(59, 29, -1))}
    expected = {name: expect(model, motion, PERIOD_S * np.arange(30))[0] for name, motion in motions.items()}
    for row in range(30):
        clock[...] = PERIOD_S * row
        for name, motion in motions.items():
            assert_equal(ask(api, pick(motion, row), sequence_id=name), expected[name], row)


def test_rejected_request_does_not_move_its_sequence(api, model):
    motion = slow_motion(40)
    ask(api, pick(motion, slice(0, 39)), sequence_id=1)
    wrong = message(pick(motion, slice(38, 39)), "tau", "tau", parameters={"sequence_id": 1, "sequence_start": True})
    error_message(api.post(infer_path(NAME), json=wrong))
    known = expect(model, motion, [0.0] * 40)[0]
    assert_equal(ask(api, pick(motion, slice(39, 40)), sequence_id=1), known, slice(39, 40))


def test_model_that_remembers_nothing_ignores_sequences(api, trained):
    motion = slow_motion(5)
    alone = ask(api, motion, name=trained.name)
    for parameters in ({"sequence_id": 1, "sequence_start": True}, {"sequence_id": 1, "sequence_end": True}):
        found = ask(api, motion, name=trained.name, **parameters)
        for name, values in alone.items():
            assert_array_equal(found[name], values)


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"sequence_id": 0}, f"parameters.sequence_id is 0, expected {ID}"),
        ({"sequence_id": -1}, f"parameters.sequence_id is -1, expected {ID}"),
        ({"sequence_id": 2**64}, f"parameters.sequence_id is {2**64}, expected {ID}"),
        ({"sequence_id": ""}, f"parameters.sequence_id is '', expected {ID}"),
        ({"sequence_id": "x" * 129}, f"parameters.sequence_id is {'x' * 129}, expected {ID}"),
        ({"sequence_id": 1.5}, f"parameters.sequence_id is 1.5, expected {ID}"),
        ({"sequence_id": True}, f"parameters.sequence_id is True, expected {ID}"),
        ({"sequence_id": 1, "sequence_start": 1}, "parameters.sequence_start is 1, expected true or false"),
        ({"sequence_id": 1, "sequence_end": "no"}, "parameters.sequence_end is no, expected true or false"),
        ({"sequence_start": True}, "`parameters.sequence_start` is true, but `parameters.sequence_id` is missing."),
        ({"sequence_end": True}, "`parameters.sequence_end` is true, but `parameters.sequence_id` is missing."),
    ],
)
def test_wrong_parameters_are_rejected(api, trained, parameters, words):
    request = message(pick(slow_motion(1), 0), parameters=parameters)
    assert error_message(api.post(infer_path(trained.name), json=request)) == words


def grpc_request(motion, **parameters):
    """Return a gRPC request for one query; parameters: (field of `InferParameter`, value)."""
    sent = pytest.importorskip("service.api.oip.rpc.messages").InferRequest(model_name=NAME)
    for name, values in motion.items():
        sent.inputs.add(name=name, datatype="FP64", shape=[len(values)]).contents.fp64_contents.extend(values)
    for name, (kind, value) in parameters.items():
        setattr(sent.parameters[name], kind, value)
    return sent


@pytest.mark.parametrize("sequence", [("int64_param", 7), ("uint64_param", 2**64 - 1), ("string_param", "arm")])
def test_calls_over_grpc_follow_their_sequence(api, model, clock, sequence):
    motion = slow_motion(40)
    expected, _ = expect(model, motion, PERIOD_S * np.arange(40))
    answer = pytest.importorskip("service.api.oip.rpc.methods")._model_infer
    for row in range(40):
        clock[...] = PERIOD_S * row
        sent = grpc_request(pick(motion, row), sequence_id=sequence, sequence_start=("bool_param", row == 0))
        reply = api.portal.call(answer, api.app.state, {"path_params": {}}, sent.SerializeToString())
        assert_equal(read_grpc(reply), expected, row)


def read_grpc(reply):
    """Return the tensors of an answer over gRPC."""
    answer = pytest.importorskip("service.api.oip.rpc.messages").InferResponse.FromString(reply.body)
    return {each.name: np.array(each.contents.fp64_contents) for each in answer.outputs}


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"sequence_id": ("int64_param", 0)}, f"parameters.sequence_id is 0, expected {ID}"),
        ({"sequence_id": ("int64_param", -5)}, f"parameters.sequence_id is -5, expected {ID}"),
        ({"sequence_id": ("string_param", "")}, f"parameters.sequence_id is '', expected {ID}"),
        ({"sequence_id": ("bool_param", True)}, f"parameters.sequence_id is True, expected {ID}"),
        ({"sequence_id": ("double_param", 1.0)}, f"parameters.sequence_id is 1.0, expected {ID}"),
        ({"sequence_start": ("int64_param", 1)}, "parameters.sequence_start is 1, expected true or false"),
        ({"sequence_end": ("bool_param", True)}, "`parameters.sequence_end` is true, but `parameters.sequence_id` is"),
    ],
)
def test_wrong_parameters_over_grpc_are_rejected(api, model, parameters, words):
    body = grpc_request(pick(slow_motion(1), 0), **parameters).SerializeToString()
    answer = pytest.importorskip("service.api.oip.rpc.methods")._model_infer
    with pytest.raises(InvalidRequestError) as caught:
        api.portal.call(answer, api.app.state, {"path_params": {}}, body)
    assert caught.value.message.startswith(words)


@pytest.fixture
def table(api, model, monkeypatch):
    """A table of three sequences; it returns whether the second query of a sequence was followed."""
    monkeypatch.setattr(sequences, "MAX_SEQUENCES", 3)
    served, kept = service_of(api).loaded.get(NAME, 1), Sequences()

    def follow(name, time, model=NAME):
        motion = np.zeros((2, 1, 2))
        motion[0] = 0.01 * time
        found = kept.follow(replace(served, name=model), SequencePart(name, False, False), time, motion)
        return bool((found[0, 0] != 0.0).any())

    follow.count = lambda: len(kept._states)
    return follow


def test_sequence_that_is_silent_longest_is_dropped(table):
    names = ["a", "b", "c"]
    assert [table(name, 0.0) for name in names] == [False] * 3
    assert [table(name, 0.1) for name in names] == [True] * 3
    assert not table("d", 0.2)
    assert [table(name, 0.2) for name in ("c", "b", "d")] == [True, True, False]
    assert table.count() == 3
    assert not table("a", 0.2)


def test_silent_sequences_are_dropped_in_time(table):
    table("a", 0.0)
    table("b", 0.2)
    table("c", 60.1)
    assert table.count() == 2


def test_sequence_belongs_to_one_model(table):
    table(1, 0.0)
    assert not table(1, 0.1, "other")
    assert table(1, 0.1)


def test_concurrent_requests_of_a_sequence_are_all_followed(table, api):
    results = []
    table("a", 0.0)
    threads = [Thread(target=lambda: results.extend(table("a", 0.2) for _ in range(200))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results == [True] * 800


def test_processes_share_a_sequence(api, model):
    served, shared = service_of(api).loaded.get(NAME, 1), Sequences(SharedStates(max_joints=3))
    motion, part = slow_motion(30), SequencePart("arm", False, False)
    _, expected = expect(model, motion, PERIOD_S * np.arange(30))

    def follow(row):
        queries = np.stack([motion["q"][row : row + 1], motion["dq"][row : row + 1]])
        return shared.follow(served, part, PERIOD_S * row, queries)

    assert_array_equal(follow(0)[0], expected[0])
    child = os.fork()
    if not child:
        for row in range(1, 20):
            follow(row)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
    for row in range(20, 30):
        assert_array_equal(follow(row)[0], expected[row])


def test_shared_sequence_replaces_the_one_that_is_silent_longest(api, model):
    served, shared = service_of(api).loaded.get(NAME, 1), Sequences(SharedStates(max_joints=2, max_sequences=PLACES))

    def follow(name, time, **ends):
        motion = np.zeros((2, 1, 2))
        motion[0] = 0.01 * time
        found = shared.follow(served, SequencePart(name, False, False)._replace(**ends), time, motion)
        return bool((found[0, 0] != 0.0).any())

    names = [f"sequence {n}" for n in range(PLACES)]
    for time, expected in ((100.0, False), (100.1, True)):
        assert [follow(name, time + 1e-3 * n) for n, name in enumerate(names)] == [expected] * PLACES
    assert not follow("another", 100.2)
    assert [follow(name, 100.2) for name in names[1:]] == [True] * (PLACES - 1)
    assert not follow(names[0], 100.21)
    assert follow(names[2], 100.22, end=True)
    assert not follow(names[2], 100.23)
    assert not follow(names[3], 100.23, start=True)
