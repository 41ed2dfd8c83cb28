"""gRPC requests of the Open Inference Protocol for the shipped model."""

import grpc
import numpy as np
from tritonclient.grpc import service_pb2 as published

from tests.service.api.oip.requests import infer_path

MOTION = {"q": [0.0, -0.5, 0.0, -2.0, 0.0, 1.5, 0.7], "dq": [0.1] * 7, "ddq": [0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0]}
PATH = infer_path("panda-sim")
Code = grpc.StatusCode


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
