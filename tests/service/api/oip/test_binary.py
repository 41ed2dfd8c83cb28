"""The binary tensor data extension: its byte layout, and answers with the same numbers as in JSON."""

import json
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_array_equal

from tests.service.api.oip import requests as oip
from tests.service.api.oip.requests import HEADER, error_message, infer, infer_binary, json_input, message, pack_numbers

Q, DQ, DDQ = [0.3, -0.7], [1.1, 0.2], [-2.0, 0.9]
MOTION = {"q": Q, "dq": DQ, "ddq": DDQ}
BATCH = {name: np.linspace(values[0], values[1], 6).reshape(3, 2) for name, values in MOTION.items()}
NAMES = ("tau", "tau_std", "noise_std", "covariance", "tau_mean", "tau_friction", "inertia_matrix", "kinetic_energy")


def request(motion, datatype="FP64", **more):
    return {"inputs": [oip.binary_input(name, values, datatype) for name, values in motion.items()], **more}


def payload(motion, datatype="FP64"):
    return b"".join(pack_numbers(values, datatype) for values in motion.values())


TEXT, DATA = json.dumps(request(MOTION)).encode(), payload(MOTION)


def post(api, body, length):
    return api.post(oip.infer_path("pendulum"), content=body, headers={HEADER: str(length)})


def test_bytes_of_a_query_and_its_answer(api, trained):
    """All bytes are written out, none built by a helper."""
    head = (
        b'{"id":"42","inputs":[{"name":"q","shape":[2],"datatype":"FP64","parameters":{"binary_data_size":16}},'
        b'{"name":"dq","shape":[2],"datatype":"FP64","parameters":{"binary_data_size":16}},'
        b'{"name":"ddq","shape":[2],"datatype":"FP32","parameters":{"binary_data_size":8}}],'
        b'"outputs":[{"name":"tau","parameters":{"binary_data":true}}]}'
    )
    body = head + struct.pack("<2d", 0.3, -0.7) + struct.pack("<2d", 1.1, 0.2) + struct.pack("<2f", -2.0, 0.5)
    headers = {"Inference-Header-Content-Length": str(len(head)), "content-type": "application/octet-stream"}
    answer = api.post(f"/v2/models/{trained.name}/infer", content=body, headers=headers)
    tau, _ = trained.model.answer(np.array([[0.3, -0.7], [1.1, 0.2], [-2.0, 0.5]]), std=False)
    text = (
        b'{"model_name":"pendulum","model_version":"1",'
        b'"parameters":{"revision":0,"torque_convention":"gravity_included"},'
        b'"outputs":[{"name":"tau","datatype":"FP64","shape":[2],"parameters":{"binary_data_size":16}}],"id":"42"}'
    )
    assert answer.content == text + struct.pack("<2d", *tau)
    assert answer.headers["inference-header-content-length"] == str(len(text))
    assert answer.headers["content-length"] == str(len(text) + 16)
    assert answer.headers["content-type"] == "application/octet-stream"


@st.composite
def request_pair(draw):
    """Return a request in JSON, and the same with some binary inputs: its JSON, its bytes, and its binary outputs."""
    shape = draw(st.sampled_from([(2,), (1, 2), (3, 2)]))
    plain, mixed, rest = [], [], b""
    for name in draw(st.permutations(["q", "dq", "ddq"])):
        datatype = draw(st.sampled_from(["FP64", "FP32"]))
        width = 64 if datatype == "FP64" else 32
        values = draw(arrays(f"f{width // 8}", shape, elements=st.floats(-12, 12, width=width)))
        plain.append(json_input(name, values, datatype))
        if draw(st.booleans()):
            mixed.append(oip.binary_input(name, values, datatype))
            rest += pack_numbers(values, datatype)
        else:
            mixed.append(plain[-1])
    outputs = draw(st.lists(st.sampled_from(NAMES), unique=True, min_size=1))
    usual = draw(st.sampled_from([None, False, True]))
    flags = [draw(st.sampled_from([None, False, True])) for _ in outputs]
    wanted = [{"name": name, "parameters": {"binary_data": flag}} for name, flag in zip(outputs, flags, strict=True)]
    binary = [name for name, flag in zip(outputs, flags, strict=True) if (usual if flag is None else flag)]
    return (
        {"inputs": plain, "outputs": [{"name": name} for name in outputs]},
        {"inputs": mixed, "outputs": wanted, "parameters": {"binary_data_output": usual}},
        rest,
        binary,
    )


@given(request_pair())
def test_binary_and_json_agree_bit_for_bit(api, trained, both):
    plain, mixed, rest, binary = both
    expected = oip.tensors(infer(api, trained.name, plain))
    answer = infer_binary(api, trained.name, mixed, rest)
    if binary:
        head, tensors = oip.binary_tensors(answer)
        assert [each["name"] for each in head["outputs"] if "data" not in each] == binary
    else:
        assert (answer.status_code, HEADER in answer.headers) == (200, False), answer.text
        tensors = oip.tensors(answer.json())
    assert list(tensors) == list(expected)
    for name, values in expected.items():
        assert_array_equal(tensors[name], values, err_msg=name)


def test_large_batch_is_binary(api, trained):
    motion = {name: np.linspace(values[0], values[1], 2400).reshape(1200, 2) for name, values in MOTION.items()}
    expected = trained.model.predict(**motion)
    wanted = request(motion, parameters={"binary_data_output": True})
    for names in (["tau_mean"], ["tau", "tau_std", "tau_mean"]):
        wanted["outputs"] = [{"name": name} for name in names]
        _, tensors = oip.binary_tensors(infer_binary(api, trained.name, wanted, payload(motion)))
        assert list(tensors) == names
        for name, values in tensors.items():
            assert_array_equal(values, getattr(expected, name.removeprefix("tau_") if name == "tau_mean" else name))
    for changes in ({"parameters": {}}, {"outputs": [{"name": "tau"}, {"name": "covariance"}]}):
        reply = error_message(infer_binary(api, trained.name, wanted | changes, payload(motion)))
        assert reply == "q.shape is [1200, 2], expected at most 1000 queries in one request"
    huge = {name: np.broadcast_to(0.0, (100_001, 2)) for name in MOTION}
    reply = error_message(infer_binary(api, trained.name, wanted | request(huge), b""))
    assert reply == "q.shape is [100001, 2], expected at most 100000 queries in one request"


@given(st.integers(0, len(TEXT + DATA) - 1))
def test_truncated_message_is_rejected(api, trained, length):
    error_message(post(api, (TEXT + DATA)[:length], len(TEXT)))


@given(
    st.lists(st.tuples(st.integers(0, len(TEXT + DATA) - 1), st.integers(0, 255)), min_size=1, max_size=4),
    st.sampled_from([-1, 0, 8]),
)
def test_corrupted_message_is_answered_or_rejected(api, trained, changes, further):
    body = bytearray(TEXT + DATA)
    for place, value in changes:
        body[place] = value
    answer = post(api, bytes(body), len(TEXT) + further)
    if answer.status_code == 200:
        assert all(np.isfinite(values).all() for values in oip.tensors(answer.json()).values())
    else:
        error_message(answer)


@pytest.mark.parametrize("size", [0, 15, 17, 2**40])
def test_sizes_must_match_the_shapes(api, trained, size):
    wrong = request(MOTION)
    wrong["inputs"][1]["parameters"]["binary_data_size"] = size
    data = pack_numbers(Q) + b"\0" * min(size, 100) + pack_numbers(DDQ)
    message = error_message(infer_binary(api, trained.name, wrong, data))
    if size == 2**40:  # the service neither waits for that many bytes nor reserves memory for them
        assert f"expected {2**40 + 32} bytes" in message
    else:
        assert message == f"dq.parameters.binary_data_size is {size}, expected 16 bytes for shape [2] of FP64"


@pytest.mark.parametrize("value", ["0", "-1", "+5", "1.5", "", "9" * 19, "9" * 5000, "0x10", "5, 6", "1000"])
def test_wrong_json_length_is_rejected(api, trained, value):
    text = json.dumps(message(MOTION)).encode()
    reply = error_message(post(api, text, value))
    assert reply.startswith(f"{HEADER} is {value[:200]}")
    assert reply.endswith(f"expected the length of the JSON in bytes, 1 to {len(text)}, the length of the body")


def test_binary_data_need_the_json_length(api, trained):
    path = oip.infer_path(trained.name)
    reply = error_message(api.post(path, content=TEXT + DATA))
    assert reply.startswith("The body is not JSON: ")
    assert f"give its length in {HEADER}" in reply
    assert HEADER in error_message(api.post(path, content=TEXT))


@pytest.mark.parametrize("datatype", ["FP64", "FP32"])
@pytest.mark.parametrize(("name", "value"), [("q", np.nan), ("dq", np.inf), ("ddq", -np.inf)])
def test_non_finite_numbers_are_named(api, trained, name, value, datatype):
    for motion, where in ((MOTION, "[1]"), (BATCH, "[2][1]")):
        wrong = {key: np.array(values, copy=True) for key, values in motion.items()}
        wrong[name][(-1,) * wrong[name].ndim] = value
        reply = error_message(infer_binary(api, trained.name, request(wrong, datatype), payload(wrong, datatype)))
        assert reply == f"{name}{where} is {value}, expected a finite number of {datatype}"
