"""Messages of the Open Inference Protocol, built and parsed without the service's code."""

import json
import math
import struct
from typing import Any

import numpy as np

HEADER = "Inference-Header-Content-Length"
EXTENSIONS = [
    "binary_tensor_data",
    "sequence",
    "sequence(string_id)",
    "model_repository",
    "model_configuration",
    "statistics",
]
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


def changed(motion: dict[str, Any], place: int, **changes: Any) -> dict[str, Any]:
    """Return a correct request with one changed input; None removes a member."""
    entire = message(motion)
    wrong = entire["inputs"][place] | changes
    entire["inputs"][place] = {key: value for key, value in wrong.items() if value is not None}
    return entire


def wrong_requests(motion: dict[str, Any], joints: str) -> dict[str, tuple[dict[str, Any], str]]:
    """Return requests that every transport rejects, from a correct query, and how the errors begin."""
    n, supported = len(motion["q"]), f"tensors in the body: the supported extensions are {', '.join(EXTENSIONS)}"
    shapes = f"[{n}] for one query or [N, {n}] for a batch: the joints are {joints}"
    region = {"shared_memory_region": "r"}
    shared, needs_tau = f"shared_memory_region is r, expected {supported}", "for forward_dynamics or tau_external"
    size = f"inputs[0].shape[0] is {-n}, expected a whole number of at least 0"

    def with_output(**parameters: Any) -> dict[str, Any]:
        return message(motion) | {"outputs": [{"name": "tau", "parameters": parameters}]}

    return {
        "unknown input": (changed(motion, 0, name="p"), "inputs[0].name is p, expected one of q, dq, ddq"),
        "input twice": (changed(motion, 1, name="q"), "Input `q` is given twice."),
        "no inputs": ({"inputs": []}, "Input `q` is missing. Required inputs: q, dq, ddq."),
        "datatype": (changed(motion, 0, datatype="INT32"), "q.datatype is INT32, expected FP64 or FP32"),
        "joints": (changed(motion, 0, shape=[3]), f"q.shape is [3], expected {shapes}"),
        "no queries": (changed(motion, 0, shape=[0, n]), f"q.shape is [0, {n}], expected {shapes}"),
        "huge": (changed(motion, 0, shape=[2**40, n]), f"q.shape is [{2**40}, {n}], expected at most 1000"),
        "negative": (changed(motion, 0, shape=[-n]), size),
        "other shape": (changed(motion, 1, shape=[1, n]), f"dq.shape is [1, {n}], expected that of q, [{n}]"),
        "shared memory": (changed(motion, 1, data=None, parameters=region), f"dq.parameters.{shared}"),
        "shared memory of an output": (with_output(**region), f"outputs[0].parameters.{shared}"),
        "classification": (
            with_output(classification=3),
            f"outputs[0].parameters.classification is 3, expected {supported}",
        ),
        "output": (message(motion, "tau", "torque"), "outputs[1].name is torque, expected an output of"),
        "output twice": (message(motion, "tau", "tau"), "Output `tau` is requested twice."),
        "no torque": (message(motion, "forward_dynamics_std"), f"`tau` is required {needs_tau}."),
        "torque in vain": (
            message(motion | {"tau": [0.0] * n}, "tau"),
            f"`tau` is used only {needs_tau}, which is not among the outputs",
        ),
        "degrees": (
            changed(motion, 0, data=[0.0, 90.0, *[0.0] * (n - 2)]),
            "q[1] is 90, expected radians (or metres) within ±12.6: are these degrees?",
        ),
    }


def infer_path(model: str, version: int | str | None = None) -> str:
    """Return the path of inference."""
    return f"/v2/models/{model}/infer" if version is None else f"/v2/models/{model}/versions/{version}/infer"


MOTION = {"q": [0.0, -0.5, 0.0, -2.0, 0.0, 1.5, 0.7], "dq": [0.1] * 7, "ddq": [0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0]}
BATCH = {name: np.linspace(values, np.array(values) + 0.3, 4) for name, values in MOTION.items()}
"""One query and four of the shipped model."""
PATH = infer_path("panda-sim")


def json_answer(server: Any, motion: dict[str, Any], *outputs: str) -> dict[str, np.ndarray]:
    """Return the tensors that the shipped model of a server answers in JSON."""
    answer = server.client.post(PATH, json=message(motion, *outputs))
    assert answer.status_code == 200, answer.text
    return tensors(answer.json())


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
