"""Messages of the Open Inference Protocol, built and parsed without the service's code."""

import json
import math
import struct
from typing import Any

import numpy as np

HEADER = "Inference-Header-Content-Length"
LETTERS = {"FP64": "d", "FP32": "f"}


def json_input(name: str, values: Any, datatype: str = "FP64") -> dict[str, Any]:
    """Return an input whose numbers are in the JSON."""
    flat = [float(value) for value in np.asarray(values).ravel()]
    return {"name": name, "shape": list(np.shape(values)), "datatype": datatype, "data": flat}


def binary_input(name: str, values: Any, datatype: str = "FP64") -> dict[str, Any]:
    """Return an input whose numbers follow the JSON."""
    size = math.prod(np.shape(values)) * struct.calcsize(LETTERS[datatype])
    parameters = {"binary_data_size": size}
    return {"name": name, "shape": list(np.shape(values)), "datatype": datatype, "parameters": parameters}


def pack_numbers(values: Any, datatype: str = "FP64") -> bytes:
    """Encode numbers in the layout of the binary extension: little-endian, row-major, without padding."""
    flat = [float(value) for value in np.asarray(values).ravel()]
    return struct.pack(f"<{len(flat)}{LETTERS[datatype]}", *flat)


def message(motion: dict[str, Any], *outputs: str, **request: Any) -> dict[str, Any]:
    """Return a JSON request for the named outputs, by default for the default ones."""
    body: dict[str, Any] = {"inputs": [json_input(name, values) for name, values in motion.items()], **request}
    return body | ({"outputs": [{"name": name} for name in outputs]} if outputs else {})


def infer_path(model: str, version: int | str | None = None) -> str:
    """Return the path of inference."""
    return f"/v2/models/{model}/infer" if version is None else f"/v2/models/{model}/versions/{version}/infer"


def infer(api: Any, model: str, request: dict[str, Any], version: int | None = None) -> dict[str, Any]:
    """Send a request in JSON; return the answer, which must be JSON alone."""
    answer = api.post(infer_path(model, version), json=request)
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/json"
    assert HEADER not in answer.headers
    return answer.json()


def infer_binary(api: Any, model: str, request: dict[str, Any], payload: bytes, **headers: str) -> Any:
    """Send a request with binary tensors; return the raw answer."""
    text = json.dumps(request).encode()
    return api.post(infer_path(model), content=text + payload, headers={HEADER: str(len(text)), **headers})


def tensors(answer: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return the tensors of a JSON answer by name, in order."""
    for each in answer["outputs"]:
        assert set(each) == {"name", "datatype", "shape", "data"}
        assert each["datatype"] == "FP64"
    return {each["name"]: np.array(each["data"]).reshape(each["shape"]) for each in answer["outputs"]}


def binary_tensors(answer: Any) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the JSON of an answer and all its tensors; check that no byte is left over."""
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/octet-stream"
    length = int(answer.headers[HEADER])
    head, rest = json.loads(answer.content[:length]), answer.content[length:]
    result = {}
    for each in head["outputs"]:
        values = each.get("data")
        if values is None:
            size = each["parameters"]["binary_data_size"]
            values, rest = struct.unpack(f"<{size // 8}d", rest[:size]), rest[size:]
        result[each["name"]] = np.array(values).reshape(each["shape"])
    assert rest == b""
    return head, result


def error_message(answer: Any, status: int = 400) -> str:
    """Check that an answer is an error of the protocol's shape; return its message."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/json"
    body = answer.json()
    assert set(body) == {"error"}
    assert isinstance(body["error"], str)
    assert body["error"]
    return body["error"]
