"""Decoders of hot routes return the same values as pydantic for the same body."""

import json

import numpy as np
import pytest
from pydantic import BaseModel, Field

from service.api.routes.observations import batches
from service.contract.decoding import HotDecoder
from service.contract.observations import ObservationRequest
from service.contract.predictions import PredictRequest
from service.foundation.json_text import read_json
from service.inference.predicting import queries

DECODERS = {PredictRequest: queries, ObservationRequest: batches}
EXAMPLES = [(model, body) for model in DECODERS for body in model.model_config["json_schema_extra"]["examples"]]
MORE = {
    PredictRequest: [
        {"version": 3, "min_revision": 0},
        {"alias": "production", "covariance": True},
        {"components": ["forward_dynamics"], "tau": [0.5] * 7},
        {"payload": {"mass": 1, "com": [0, 0, 0.1]}},
        {"version": None, "alias": None, "tau": None, "payload": None, "components": []},
        {name: [[0, 1], [2, 3e-1]] for name in ("q", "dq", "ddq")},
        {"t": [0, 0.5], "trajectory": True, "history": None},
        {"t": 2, "history": {"t": [0, 1.5], "q": [[0, 1], [2, 3]], "dq": [[0.5, 0.25], [0, 0]]}},
    ],
    ObservationRequest: [
        {"t": None, "ddq": None},
        {"t": 1, "q": [0.5, None], "dq": [1, 2], "tau": [3, 4], "joint_names": ["a", "b"]},
        {"sequence": 2**53 - 1, "stream_id": "x" * 64, "joint_names": None},
    ],
}
"""Further fields of the examples."""
TEXTS = """
    null true false 0 -0.0 1 -1 1.0 1.5 0.1000000000000000055511151231257827 9007199254740993 2147483648 1e400 NaN
    "" "1" "a" "production" "production\\n" "a\\u0000" "\\ud800" "é" {} {"a":1} [] [[]] [null] [true] ["1"] ["a","a"]
    [0.1] [[0.1]] [[0,1],[2]] [[0,1],2] [0,[1]] [[[0]]] [1e400] [NaN] [[0,null]] [[],[]] ["gravity"]
    ["gravity","gravity"] ["gravity","heat"] {"mass":1} {"mass":1,"com":[0,0]} {"mass":0,"com":[0,0,0]}
    {"mass":1,"mass":2,"com":[0,0,0]} {"mass":1,"com":[0,0,0],"q":1} {"mass":true,"com":[0,0,0]}
    {"t":[0],"q":[[0]],"dq":[[1]]} {"t":[0],"q":[[0]],"dq":[[1,null]]} {"t":[0],"q":[[0]],"dq":[[1]],"t":[1]}
"""
"""Values that are correct for some fields and wrong for most."""


def pydantic_values(model, body):
    """Return the values of a body by field, None if it is rejected."""
    try:
        return vars(model.model_validate(read_json(body)))
    except Exception:  # any error of a validator
        return None


def decoder_values(decoder, body):
    decoded = decoder.decode(body)
    request = None if decoded is None else decoder.request(decoded)
    return None if request is None else vars(request)


def assert_same(decoded, expected):
    assert expected is not None
    assert decoded.keys() == expected.keys()
    for name, value in expected.items():
        assert type(decoded[name]) is type(value)
        if isinstance(value, BaseModel):
            assert_same(vars(decoded[name]), vars(value))
        elif isinstance(value, np.ndarray):
            assert (decoded[name].dtype, decoded[name].shape) == (value.dtype, value.shape)
            assert decoded[name].tobytes() == value.tobytes()
        else:
            assert decoded[name] == value


def encode_fields(fields):
    return ("{" + ",".join(f'"{name}":{value}' for name, value in fields) + "}").encode()


@pytest.mark.parametrize(("model", "example"), EXAMPLES)
def test_correct_bodies_are_decoded(model, example):
    for more in ({}, *MORE[model]):
        body = json.dumps(example | more).encode()
        assert_same(decoder_values(DECODERS[model], body), pydantic_values(model, body))


@pytest.mark.parametrize(("model", "example"), EXAMPLES)
def test_decoder_accepts_only_what_pydantic_accepts(model, example):
    fields = {name: json.dumps(value) for name, value in example.items()}
    bodies = [b"", b"[]", b"{", b"{}", b"null", b'{"q": 1}', b"[" * 100_000, json.dumps(example).encode("utf-16")]
    for name in (*model.model_fields, "more"):
        bodies.append(encode_fields([each for each in fields.items() if each[0] != name]))
        for value in TEXTS.split():
            bodies.append(encode_fields((fields | {name: value}).items()))
            bodies.append(encode_fields([*fields.items(), (name, value)]))
            bodies.append(encode_fields([*fields.items(), (f"\\u{ord(name[0]):04x}{name[1:]}", value)]))
    decoded = 0
    for body in bodies:
        if (values := decoder_values(DECODERS[model], body)) is not None:
            decoded += 1
            assert_same(values, pydantic_values(model, body))
    assert decoded > len(model.model_fields)


def test_new_field_is_decoded_with_its_constraints():
    class LaterRequest(PredictRequest):
        gain: int = Field(7, ge=1)

    decoder = HotDecoder(LaterRequest)
    bare = {"q": [0.0], "dq": [0.0], "ddq": [0.0]}
    gains = [decoder_values(decoder, json.dumps(bare | more).encode()) for more in ({}, {"gain": 2}, {"gain": 0})]
    assert [None if values is None else values["gain"] for values in gains] == [7, 2, None]
