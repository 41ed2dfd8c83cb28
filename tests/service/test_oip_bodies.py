"""The Open Inference Protocol: bodies that are no request, and values whose JSON type is wrong."""

from __future__ import annotations

import pytest

from tests.service.oip import path_of, refused

PATH = path_of("pendulum")


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        ("q", "NaN", "inputs[0].data[1] is nan, expected a finite number"),
        ("q", "-Infinity", "inputs[0].data[1] is -inf, expected a finite number"),
        ("q", "1e400", "inputs[0].data[1] is inf, expected a finite number"),
        ("q", "1" + "0" * 400, "inputs[0].data[1] is 1" + "0" * 199 + "…, expected a finite number"),
        ("q", "9" * 5000, "inputs[0].data[1] is out of range, expected a finite number"),
        ("q", '"1.0"', "inputs[0].data[1] is 1.0, expected a number, or a list of numbers"),
        ("q", "true", "inputs[0].data[1] is True, expected a number, or a list of numbers"),
        ("q", "null", "inputs[0].data[1] is null, expected a number, or a list of numbers"),
        ("q", "{}", "inputs[0].data[1] is {}, expected a number, or a list of numbers"),
        ("q", "[[0]]", "inputs[0].data[1][0] is [0], expected a number"),
        ("shape", "2.0", "inputs[0].shape[0] is 2.0, expected a whole number"),
        ("shape", "-2", "inputs[0].shape[0] is -2, expected a whole number of at least 0"),
        ("shape", '"2"', "inputs[0].shape[0] is 2, expected a whole number"),
        ("size", "-16", "inputs[0].parameters.binary_data_size is -16, expected a whole number of at least 0"),
        ("size", "true", "inputs[0].parameters.binary_data_size is True, expected a whole number"),
    ],
)
def test_values_of_wrong_types_are_named(api, trained, place, value, said):
    values = {"q": "-0.7", "shape": "2", "size": "null"} | {place: value}
    tensor = (
        f'{{"name": "q", "datatype": "FP64", "shape": [{values["shape"]}], "data": [0, {values["q"]}], '
        f'"parameters": {{"binary_data_size": {values["size"]}}}}}'
    )
    assert refused(api.post(PATH, content=f'{{"inputs": [{tensor}]}}')) == said


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (b"", "the body is not JSON: Input data was truncated, expected an inference request as JSON"),
        (b"{", "the body is not JSON: Input data was truncated, expected"),
        (b"q=0", "the body is not JSON: invalid character (byte 0), expected"),
        (b'{"inputs": [01]}', "the body is not JSON: "),
        (b'{"inputs": []} {}', "the body is not JSON: trailing characters (byte "),
        (b"\xef\xbb\xbf{}", "the body is not JSON: invalid character (byte 0), expected"),
        (b'{"id": "\xff"}', "the body is not JSON: 'utf-8' codec can't decode byte 0xff"),
        (b'{"id": "\\ud800"}', "the body is not JSON: "),
        (b'{"\\ud800": 1}', "the body is not JSON: "),
        (b'{"parameters": {"x": ' + b"[" * 15_000, "the body is not JSON: maximum recursion depth exceeded"),
        (b'{"parameters": {"x": ' + b"[" * 900 + b"NaN", "the body is not JSON: "),
        (b"[" * 15_000, "the body is array, expected an object"),
        (b"[]", "the body is [], expected an object"),
        (b'"text"', "the body is text, expected an object"),
        (b"null", "the body is null, expected an object"),
        (b"{}", "inputs is missing, expected a value"),
        (b'{"inputs": {}}', "inputs is {}, expected a list"),
        (b'{"inputs": [{}]}', "inputs[0].name is missing, expected a value"),
        (b'{"inputs": [{"name": "q", "shape": [2]}]}', "inputs[0].datatype is missing, expected a value"),
        (b'{"inputs": [], "output": []}', "output is given, expected no field of that name"),
        (b'{"inputs": [{"nam": 1}]}', "inputs[0].nam is given, expected no field of that name"),
        (b'{"inputs": [], "outputs": [{"nam": 1}]}', "outputs[0].nam is given, expected no field of that name"),
        (b'{"inputs": [], "outputs": ["tau"]}', "outputs[0] is tau, expected an object"),
        (b'{"inputs": [], "id": 42}', "id is 42, expected a string"),
        (b'{"inputs": [], "parameters": {"binary_data_output": 1}}', "parameters.binary_data_output is 1, expected tr"),
        (b'{"inputs": [{"name": 5}], "inputs": []}', "inputs[0].name is int, expected a string"),
        (b'{"inputs": [{"name": 5}], "inputs": {}}', "inputs[0].name is int, expected a string"),
    ],
)
def test_bodies_that_are_no_request(api, trained, body, said):
    assert refused(api.post(PATH, content=body)).startswith(said)
