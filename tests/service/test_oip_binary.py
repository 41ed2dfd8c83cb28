"""The binary tensor data extension, byte by byte."""

from __future__ import annotations

import itertools
import json
import struct

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from tests.service.oip import (
    HEADER,
    announced,
    ask,
    binary_tensors,
    listed,
    message,
    packed,
    path_of,
    refused,
    send,
    tensors,
)

Q, DQ, DDQ = [0.3, -0.7], [1.1, 0.2], [-2.0, 0.9]
MOTION = {"q": Q, "dq": DQ, "ddq": DDQ}
BATCH = {name: np.linspace(values[0], values[1], 6).reshape(3, 2) for name, values in MOTION.items()}
BINARY = {"parameters": {"binary_data_output": True}}


def request(motion, datatype="FP64", **more):
    return {"inputs": [announced(name, values, datatype) for name, values in motion.items()], **more}


def payload(motion, datatype="FP64"):
    return b"".join(packed(values, datatype) for values in motion.values())


def test_bytes_of_a_query_and_of_its_answer(api, trained):
    """Everything spelt out, nothing built by a helper."""
    head = (
        b'{"id":"42","inputs":[{"name":"q","shape":[2],"datatype":"FP64","parameters":{"binary_data_size":16}},'
        b'{"name":"dq","shape":[2],"datatype":"FP64","parameters":{"binary_data_size":16}},'
        b'{"name":"ddq","shape":[2],"datatype":"FP32","parameters":{"binary_data_size":8}}],'
        b'"outputs":[{"name":"tau","parameters":{"binary_data":true}}]}'
    )
    body = head + struct.pack("<2d", 0.3, -0.7) + struct.pack("<2d", 1.1, 0.2) + struct.pack("<2f", -2.0, 0.5)
    answer = api.post(
        f"/v2/models/{trained.name}/infer",
        content=body,
        headers={"Inference-Header-Content-Length": str(len(head)), "content-type": "application/octet-stream"},
    )
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


@pytest.mark.parametrize("motion", [MOTION, BATCH], ids=["query", "batch"])
@pytest.mark.parametrize("datatype", ["FP64", "FP32"])
def test_binary_and_json_are_answered_alike(api, trained, motion, datatype):
    head, found = binary_tensors(
        send(api, trained.name, request(motion, datatype, **BINARY), payload(motion, datatype))
    )
    asked = {"inputs": [listed(name, values, datatype) for name, values in motion.items()]}
    plain = ask(api, trained.name, asked)
    for name, values in tensors(plain).items():
        assert_array_equal(found[name], values)
    assert [each["name"] for each in head["outputs"]] == ["tau", "tau_std"]
    assert head["parameters"] == plain["parameters"]


@pytest.mark.parametrize("names", list(itertools.permutations(MOTION)))
def test_binary_data_lie_in_the_order_of_the_inputs(api, trained, names):
    turned = {name: MOTION[name] for name in names}
    _, found = binary_tensors(send(api, trained.name, request(turned, **BINARY), payload(turned)))
    assert_array_equal(found["tau"], tensors(ask(api, trained.name, message(MOTION)))["tau"])


@pytest.mark.parametrize("binary", [{"q"}, {"ddq"}, {"q", "ddq"}, {"dq", "q"}])
def test_inputs_may_be_mixed(api, trained, binary):
    inputs = [(announced if name in binary else listed)(name, values) for name, values in MOTION.items()]
    rest = b"".join(packed(values) for name, values in MOTION.items() if name in binary)
    answer = send(api, trained.name, {"inputs": inputs}, rest)
    assert answer.headers["content-type"] == "application/json"
    assert answer.json() == ask(api, trained.name, message(MOTION))


@pytest.mark.parametrize(
    ("usual", "asked", "binary"),
    [
        (None, [None, None], []),
        (False, [None, None], []),
        (True, [None, None], ["tau", "tau_std"]),
        (True, [False, None], ["tau_std"]),
        (None, [None, True], ["tau_std"]),
        (False, [True, False], ["tau"]),
        (True, [False, False], []),
    ],
)
def test_what_is_answered_in_binary(api, trained, usual, asked, binary):
    outputs = [
        {"name": name} | ({} if flag is None else {"parameters": {"binary_data": flag}})
        for name, flag in zip(("tau", "tau_std"), asked, strict=True)
    ]
    whole = message(MOTION) | {"outputs": outputs}
    if usual is not None:
        whole["parameters"] = {"binary_data_output": usual}
    answer = api.post(path_of(trained.name), json=whole)
    plain = tensors(ask(api, trained.name, message(MOTION)))
    if not binary:
        assert HEADER not in answer.headers
        assert answer.json() == ask(api, trained.name, message(MOTION))
        return
    head, found = binary_tensors(answer)
    assert [each["name"] for each in head["outputs"] if "data" not in each] == binary
    for name, values in plain.items():
        assert_array_equal(found[name], values)


def test_every_output_has_a_binary_form(api, trained):
    names = [each["name"] for each in api.get(f"/v2/models/{trained.name}").json()["outputs"]]
    seen = trained.samples.rows(np.array([0, 20, 40]))  # postures whose inertia is known
    motion = {"q": seen.q, "dq": seen.dq, "ddq": seen.ddq, "tau": np.ones((3, 2))}
    outputs = [{"name": name} for name in names]
    head, found = binary_tensors(send(api, trained.name, request(motion, outputs=outputs, **BINARY), payload(motion)))
    assert [each["name"] for each in head["outputs"]] == names
    for name, values in tensors(ask(api, trained.name, message(motion, *names))).items():
        assert_array_equal(found[name], values, err_msg=name)


def test_a_header_for_json_alone_is_allowed(api, trained):
    assert send(api, trained.name, message(MOTION), b"").json() == ask(api, trained.name, message(MOTION))


def test_spaces_after_the_json_belong_to_it_or_are_surplus(api, trained):
    text = json.dumps(request(MOTION)).encode()
    for spaces, fits in ((b"   ", True), (b"", False)):
        headers = {HEADER: str(len(text + spaces))}
        answer = api.post(path_of(trained.name), content=text + b"   " + payload(MOTION), headers=headers)
        assert (answer.status_code == 200) is fits


@pytest.mark.parametrize("surplus", [-48, -17, -1, 1, 8])
def test_data_that_are_cut_off_or_too_many(api, trained, surplus):
    data = payload(MOTION)
    sent = data[:surplus] if surplus < 0 else data + b"\0" * surplus
    said = refused(send(api, trained.name, request(MOTION), sent))
    assert said == (
        f"the binary data is {48 + surplus} bytes, expected 48 bytes, the sum of every binary_data_size, after the "
        f"JSON whose length {HEADER} gives"
    )


@pytest.mark.parametrize("size", [0, 8, 15, 17, 2**40])
def test_sizes_have_to_be_those_of_the_shapes(api, trained, size):
    wrong = request(MOTION)
    wrong["inputs"][1]["parameters"]["binary_data_size"] = size
    data = packed(Q) + b"\0" * min(size, 100) + packed(DDQ)
    said = refused(send(api, trained.name, wrong, data))
    if size == 2**40:  # nothing of that length is waited for or made room for
        assert f"expected {2**40 + 32} bytes" in said
    else:
        assert said == f"dq.parameters.binary_data_size is {size}, expected 16 bytes: the shape [2] of FP64"


@pytest.mark.parametrize("value", ["0", "-1", "+5", "1.5", "x", "", "1e2", "9" * 19, "9" * 5000, "0x10", "5, 6"])
def test_lengths_of_the_json_that_are_none(api, trained, value):
    text = json.dumps(message(MOTION)).encode()
    said = refused(api.post(path_of(trained.name), content=text, headers={HEADER: value}))
    assert said.startswith(f"{HEADER} is {value[:200]}")
    assert said.endswith(f"expected the length of the JSON in bytes, from 1 to the {len(text)} of the body")


def test_a_length_beyond_the_body(api, trained):
    text = json.dumps(message(MOTION)).encode()
    said = refused(api.post(path_of(trained.name), content=text, headers={HEADER: str(len(text) + 1)}))
    assert said.startswith(f"{HEADER} is {len(text) + 1}, expected")


@pytest.mark.parametrize("wrong", [-1, 1])
def test_a_length_that_misses_the_end_of_the_json(api, trained, wrong):
    text = json.dumps(request(MOTION)).encode()
    answer = api.post(path_of(trained.name), content=text + payload(MOTION), headers={HEADER: str(len(text) + wrong)})
    assert refused(answer).startswith(f"the body, up to byte {len(text) + wrong} as {HEADER} says, is not JSON: ")


def test_binary_data_without_the_length_of_the_json(api, trained):
    text = json.dumps(request(MOTION)).encode()
    said = refused(api.post(path_of(trained.name), content=text + payload(MOTION)))
    assert said.startswith("the body is not JSON: ")
    assert f"is to be given in {HEADER}" in said
    assert HEADER in refused(api.post(path_of(trained.name), content=text))


@pytest.mark.parametrize("datatype", ["FP64", "FP32"])
@pytest.mark.parametrize(("value", "shown"), [(np.nan, "nan"), (np.inf, "inf"), (-np.inf, "-inf")])
@pytest.mark.parametrize("name", ["q", "dq", "ddq"])
def test_numbers_that_are_not_finite_are_named(api, trained, name, value, shown, datatype):
    for motion, where in ((MOTION, "[1]"), (BATCH, "[2][1]")):
        wrong = {key: np.array(values, copy=True) for key, values in motion.items()}
        wrong[name][(-1,) * wrong[name].ndim] = value
        said = refused(send(api, trained.name, request(wrong, datatype), payload(wrong, datatype)))
        assert said == f"{name}{where} is {shown}, expected a finite number of {datatype}"


def test_every_bit_pattern_is_a_number_or_refused(api, trained):
    """Signalling NaN of FP32 too, which converting to FP64 raises a flag for."""
    data = struct.pack("<2f", *Q) + struct.pack("<2f", *DQ) + struct.pack("<2I", 0x7F800001, 0)
    assert "ddq[0] is nan" in refused(send(api, trained.name, request(MOTION, "FP32"), data))
