"""All transports of a running service, and an echo of each kind of connection as the floor of its cost."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from typing import Any

import numpy as np

from benchmarks.clients import Address, HttpClient, post
from benchmarks.latency.subjects import Subject
from benchmarks.latency.websocket import WebSocket, frame, read_answer, request_frame
from benchmarks.workload import MODEL, Bed
from lipcore.data.samples import Array
from lipserve import StreamClient
from lipserve.frames import request_bytes
from service.api.oip.schema import HEADER

CLIENT = "ws-client"
_LABELS = {
    "ws": "WebSocket",
    "ws-unix": "WebSocket, Unix socket",
    CLIENT: "WebSocket, StreamClient",
    "http": "HTTP JSON",
    "http-unix": "HTTP JSON, Unix socket",
    "v2-json": "/v2 infer, JSON",
    "v2-binary": "/v2 infer, binary",
    "grpc": "gRPC ModelInfer",
}
_ECHOES = {
    "echo-ws": "WebSocket echo",
    "echo-ws-unix": "WebSocket echo, Unix socket",
    "echo-http": "HTTP echo",
    "echo-http-unix": "HTTP echo, Unix socket",
}
_FLOORS = {name.removeprefix("echo-"): name for name in _ECHOES}
_FLOORS |= {"v2-json": "echo-http", "v2-binary": "echo-http", "grpc": "echo-http", CLIENT: "echo-ws"}
KEYS = (*_LABELS, *_ECHOES)
_TENSORS = ("q", "dq", "ddq")
_OUTPUTS = ("tau", "tau_std")
_STREAM = f"/v1/models/{MODEL}/stream"
NOTE = (
    "Over sockets, a minimal client keeps one connection, sends prepared requests, and reads answers without decoding "
    "them. An echo returns a body of the mean size of query and answer (for /v2 and gRPC: of HTTP JSON). StreamClient "
    "is the package's own client, which encodes and decodes."
)

Answer = tuple[Array, Array | None]


def floors(names: Iterable[str], loop: str) -> set[str]:
    """Return the subjects to measure beside the named ones: their echoes; for the control loop, stream and echo."""
    needed = {_FLOORS[name] for name in names if name in _FLOORS}
    return needed | ({"ws", "echo-ws"} if loop in names else set())


def open_all(bed: Bed, wanted: Callable[[str], bool], stack: ExitStack) -> list[Subject]:
    """Open a connection for every wanted subject, each followed by its echo; `stack` closes them."""
    found = []
    for suffix, address in (("", bed.tcp), ("-unix", bed.unix)):
        if wanted(f"ws{suffix}") or wanted(f"echo-ws{suffix}"):
            found += _websocket(bed, address, suffix, stack)
        if not suffix:
            found += [_stream_client(bed, stack)] if wanted(CLIENT) else []
        if wanted(f"http{suffix}") or wanted(f"echo-http{suffix}"):
            found += _http(bed, address, suffix, stack)
        if not suffix:
            found += [_v2(bed, key, stack) for key in ("v2-json", "v2-binary") if wanted(key)]
            found += [_grpc(bed.grpc, bed, stack)] if wanted("grpc") and bed.grpc is not None else []
    return [subject for subject in found if wanted(subject.key)]


def open_loop(bed: Bed, deadline: float, stack: ExitStack) -> tuple[Subject, Callable[[], int]]:
    """Open a stream for the control loop; deadline in s.

    Returns:
        The subject, and a function that returns the service's count of late answers.
    """
    stream = stack.enter_context(WebSocket(bed.tcp, _STREAM))
    frames = [request_frame(motion, deadline=deadline) for motion in bed.workload.queries]
    late = 0

    def ask(number: int) -> None:
        nonlocal late
        late = read_answer(stream.ask(frames[number % len(frames)]))[2]

    return Subject("loop", "control loop", ask), lambda: late


def _websocket(bed: Bed, address: Address, suffix: str, stack: ExitStack) -> list[Subject]:
    asked = stack.enter_context(WebSocket(address, _STREAM))
    echo = stack.enter_context(WebSocket(address, "/v1/echo/stream"))
    frames = [request_frame(motion) for motion in bed.workload.queries]
    size = (request_bytes(bed.workload.model.n_joints) + len(asked.ask(frames[0]))) // 2
    echoed, count = frame(bytes(size)), len(frames)

    def answer(number: int) -> Answer:
        tau, std, _ = read_answer(asked.ask(frames[number]))
        return tau, std

    return [
        _subject(f"ws{suffix}", lambda number: asked.ask(frames[number % count]), answer),
        Subject(f"echo-ws{suffix}", _ECHOES[f"echo-ws{suffix}"], lambda number: echo.ask(echoed)),
    ]


def _stream_client(bed: Bed, stack: ExitStack) -> Subject:
    client = stack.enter_context(StreamClient(MODEL, bed.client.url))
    queries = [tuple(motion) for motion in bed.workload.queries]
    count = len(queries)

    def answer(number: int) -> Answer:
        found = client.predict(*queries[number])
        return found.tau, found.tau_std

    return _subject(CLIENT, lambda number: client.predict(*queries[number % count]), answer)


def _http(bed: Bed, address: Address, suffix: str, stack: ExitStack) -> list[Subject]:
    asked, echo = (stack.enter_context(HttpClient(address)) for _ in range(2))
    bodies = [json.dumps(dict(zip(_TENSORS, motion.tolist(), strict=True))).encode() for motion in bed.workload.queries]
    requests, count = [post(f"/v1/models/{MODEL}/predict", body) for body in bodies], len(bodies)
    size = (len(bodies[0]) + len(asked.ask(requests[0]))) // 2
    echoed = post("/v1/echo", json.dumps("x" * (size - 2)).encode())

    def answer(number: int) -> Answer:
        found = json.loads(asked.ask(requests[number]))
        return np.array(found["tau"]), np.array(found["tau_std"])

    return [
        _subject(f"http{suffix}", lambda number: asked.ask(requests[number % count]), answer),
        Subject(f"echo-http{suffix}", _ECHOES[f"echo-http{suffix}"], lambda number: echo.ask(echoed)),
    ]


def _v2(bed: Bed, key: str, stack: ExitStack) -> Subject:
    client, binary = stack.enter_context(HttpClient(bed.tcp)), key == "v2-binary"
    requests = [_infer(motion, binary) for motion in bed.workload.queries]
    count = len(requests)

    def answer(number: int) -> Answer:
        head, body = client.exchange(requests[number])
        if not binary:
            found = {each["name"]: np.array(each["data"]) for each in json.loads(body)["outputs"]}
            return found["tau"], found["tau_std"]
        at = head.index(HEADER.lower().encode()) + len(HEADER) + 1
        tau, std = np.frombuffer(body, "<f8", offset=int(head[at:].split(b"\r\n", 1)[0])).reshape(2, -1)
        return tau, std

    return _subject(key, lambda number: client.ask(requests[number % count]), answer)


def _infer(motion: Array, binary: bool) -> bytes:
    """Return an inference request for one motion."""
    inputs: list[dict[str, Any]] = []
    for tensor, values in zip(_TENSORS, motion, strict=True):
        content = {"parameters": {"binary_data_size": values.nbytes}} if binary else {"data": values.tolist()}
        inputs.append({"name": tensor, "shape": [len(values)], "datatype": "FP64", **content})
    outputs = [{"name": each, **({"parameters": {"binary_data": True}} if binary else {})} for each in _OUTPUTS]
    text = json.dumps({"inputs": inputs, "outputs": outputs}).encode()
    path = f"/v2/models/{MODEL}/infer"
    if not binary:
        return post(path, text)
    body = text + np.ascontiguousarray(motion, "<f8").tobytes()
    return post(path, body, "application/octet-stream", {HEADER: str(len(text))})


def _grpc(address: tuple[str, int], bed: Bed, stack: ExitStack) -> Subject:
    import grpc  # noqa: PLC0415 - of an extra, like the modules below

    from service.api.oip.rpc.definition import SERVICE  # noqa: PLC0415
    from service.api.oip.rpc.messages import InferRequest, InferResponse  # noqa: PLC0415

    channel = stack.enter_context(grpc.insecure_channel("{}:{}".format(*address)))
    ask = channel.unary_unary(f"/{SERVICE}/ModelInfer")
    requests = []
    for motion in bed.workload.queries:
        request = InferRequest(model_name=MODEL)
        for tensor, values in zip(_TENSORS, motion, strict=True):
            request.inputs.add(name=tensor, datatype="FP64", shape=[len(values)])
            request.raw_input_contents.append(values.astype("<f8").tobytes())
        requests.append(request.SerializeToString())
    count = len(requests)

    def answer(number: int) -> Answer:
        tau, std = InferResponse.FromString(ask(requests[number])).raw_output_contents
        return np.frombuffer(tau, "<f8"), np.frombuffer(std, "<f8")

    return _subject("grpc", lambda number: ask(requests[number % count]), answer)


def _subject(key: str, ask: Callable[[int], object], answer: Callable[[int], Answer]) -> Subject:
    return Subject(key, _LABELS[key], ask, floor=_FLOORS[key], answer=answer)
