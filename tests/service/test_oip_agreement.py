"""Whatever is asked, JSON and binary are answered with the same numbers; whatever is sent, with 200 or a reason."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_array_equal

from tests.service.oip import HEADER, announced, ask, binary_tensors, listed, packed, path_of, refused, send, tensors

NAMES = ("tau", "tau_std", "noise_std", "covariance", "tau_friction")


@st.composite
def messages(draw):
    """The same request twice: its inputs in JSON, and some of them in binary with what follows the JSON."""
    shape = draw(st.sampled_from([(2,), (1, 2), (3, 2)]))
    plain, mixed, payload = [], [], b""
    for name in draw(st.permutations(["q", "dq", "ddq"])):
        datatype = draw(st.sampled_from(["FP64", "FP32"]))
        width = 64 if datatype == "FP64" else 32
        values = draw(arrays(f"f{width // 8}", shape, elements=st.floats(-12, 12, width=width)))
        plain.append(listed(name, values, datatype))
        if draw(st.booleans()):
            mixed.append(announced(name, values, datatype))
            payload += packed(values, datatype)
        else:
            mixed.append(plain[-1])
    outputs = draw(st.lists(st.sampled_from(NAMES), unique=True, min_size=1))
    flags = draw(st.lists(st.booleans(), min_size=len(outputs), max_size=len(outputs)))
    asked = [{"name": name, "parameters": {"binary_data": flag}} for name, flag in zip(outputs, flags, strict=True)]
    return (
        {"inputs": plain, "outputs": [{"name": name} for name in outputs]},
        {"inputs": mixed, "outputs": asked},
        payload,
    )


@given(messages())
def test_binary_and_json_agree_to_the_last_bit(api, trained, both):
    plain, mixed, payload = both
    expected = tensors(ask(api, trained.name, plain))
    answer = send(api, trained.name, mixed, payload)
    if HEADER in answer.headers:
        _, found = binary_tensors(answer)
    else:
        assert answer.status_code == 200, answer.text
        found = tensors(answer.json())
    assert list(found) == list(expected)
    for name, values in expected.items():
        assert_array_equal(found[name], values, err_msg=name)


@pytest.fixture(scope="module")
def whole():
    """A right message: its JSON and its binary tensors."""
    inputs = [announced(name, [0.5, -0.25]) for name in ("q", "dq", "ddq")]
    return json.dumps({"inputs": inputs}).encode(), packed([0.5, -0.25]) * 3


@given(data=st.data())
def test_a_message_cut_off_anywhere_is_refused(api, trained, whole, data):
    text, payload = whole
    length = data.draw(st.integers(0, len(text) + len(payload) - 1))
    refused(api.post(path_of(trained.name), content=(text + payload)[:length], headers={HEADER: str(len(text))}))


@given(data=st.data())
def test_a_message_with_wrong_bytes_is_answered_or_refused(api, trained, whole, data):
    text, payload = whole
    body = bytearray(text + payload)
    places = st.tuples(st.integers(0, len(body) - 1), st.integers(0, 255))
    for place, value in data.draw(st.lists(places, min_size=1, max_size=4)):
        body[place] = value
    length = data.draw(st.sampled_from([len(text), len(text) - 1, len(text) + 8]))
    answer = api.post(path_of(trained.name), content=bytes(body), headers={HEADER: str(length)})
    if answer.status_code == 200:
        assert all(np.isfinite(values).all() for values in tensors(answer.json()).values())
    else:
        refused(answer)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["name", "data", "x"]), inner),
    max_leaves=6,
)


@given(data=st.data())
def test_json_of_any_kind_is_answered_or_refused(api, trained, data):
    """Python's JSON at that, which has NaN."""
    request = {"inputs": [listed(name, [0.5, -0.25]) for name in ("q", "dq", "ddq")], "outputs": [{"name": "tau"}]}
    place = data.draw(st.sampled_from([request, request["inputs"][0], request["outputs"][0]]))
    place[data.draw(st.sampled_from([*place, "parameters", "id"]))] = data.draw(JSON)
    answer = api.post(path_of(trained.name), content=json.dumps(request).encode())
    if answer.status_code != 200:
        refused(answer)
