"""A service that listens for gRPC, and requests of the Open Inference Protocol for its shipped model."""

from contextlib import contextmanager
from dataclasses import dataclass

import grpc
import numpy as np
import pytest
from tritonclient.grpc import service_pb2 as published
from tritonclient.grpc.service_pb2_grpc import GRPCInferenceServiceStub

from tests.service.data import DEADLINE
from tests.service.server import Server, free_port

Code = grpc.StatusCode


@dataclass(frozen=True)
class GrpcService:
    """A service in its own process that listens for gRPC, and a channel to it."""

    server: Server
    port: int
    channel: grpc.Channel
    stub: GRPCInferenceServiceStub

    def call_error(self, call, *arguments, **options) -> grpc.RpcError:
        """Return the error in which a call ends."""
        with pytest.raises(grpc.RpcError) as caught:
            call(*arguments, timeout=DEADLINE, **options)
        return caught.value


@contextmanager
def start_service(home, constants=None, **settings):
    """Start a service on a home."""
    port = free_port()
    with (
        Server(home, warm=True, constants=constants, LIPSERVE_GRPC_PORT=str(port), **settings) as server,
        grpc.insecure_channel(f"127.0.0.1:{port}") as channel,
    ):
        yield GrpcService(server, port, channel, GRPCInferenceServiceStub(channel))


def request(motion, *outputs, datatype="FP64", raw=True, **fields):
    """Return a request of the published definition."""
    made = published.ModelInferRequest(**{"model_name": "panda-sim", **fields})
    for name, values in motion.items():
        tensor = made.inputs.add(name=name, datatype=datatype, shape=np.shape(values))
        flat = np.ravel(values)
        if raw:
            made.raw_input_contents.append(flat.astype({"FP64": "<f8", "FP32": "<f4"}[datatype]).tobytes())
        else:
            getattr(tensor.contents, {"FP64": "fp64_contents", "FP32": "fp32_contents"}[datatype]).extend(flat)
    for name in outputs:
        made.outputs.add(name=name)
    return made


def grpc_request(message):
    """Return the request that a JSON message stands for."""
    made = request({})
    for each in message["inputs"]:
        add(made.inputs, each, datatype=each["datatype"], shape=each["shape"])
        made.raw_input_contents.append(np.array(each.get("data", []), "<f8").tobytes())
    for each in message.get("outputs", []):
        add(made.outputs, each)
    return made


def add(tensors, described, **fields):
    """Add an input or an output with its parameters."""
    tensor = tensors.add(name=described["name"], **fields)
    for name, value in described.get("parameters", {}).items():
        setattr(tensor.parameters[name], "string_param" if isinstance(value, str) else "int64_param", value)
