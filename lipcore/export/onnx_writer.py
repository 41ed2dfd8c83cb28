"""A model as a model repository of ONNX, for onnxruntime and Triton.

Example:
    session = onnxruntime.InferenceSession("FOLDER/my-arm/1/model.onnx")
    tau, tau_std = session.run(None, {"q": q, "dq": dq, "ddq": ddq})  # float64, (batch, n)
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lipcore.data.motion import Array
from lipcore.export.function import TorqueFunction, function
from lipcore.export.function_sheet import RESULTS, FunctionSheet
from lipcore.export.onnx_trace import BatchLengthError, Graph
from lipcore.export.origin import ModelOrigin
from lipcore.extras import import_extra
from lipcore.model.torque_model import TorqueModel

OPSET, IR_VERSION = 18, 9
"""Versions that onnxruntime runs since 1.17."""
BATCHES = (1009, 1013, 1019)
"""Example lengths of a batch. At least one of these primes is not the length of another axis."""
MAX_BATCH = 65536
"""Largest batch that Triton sends; it may merge smaller requests."""

README = """\
# {stem}

An inverse-dynamics model in ONNX: torque and its standard deviation at a batch of states. This folder is a model
repository: `tritonserver --model-repository=FOLDER` serves it. onnxruntime loads the file `model.onnx` of each model.

{models}
`self_test.json` states joints, units, origin and arguments, and has {count} states with expected results.
{single}"""
SINGLE = "In float32, torques deviate by about 1e-6 of the largest, standard deviations by about 1e-3.\n"
NO_SINGLE = "There is no float32 file: in this model, large numbers cancel, so it needs float64.\n"


def onnx_files(model: TorqueModel, origin: ModelOrigin) -> dict[str, bytes]:
    """Return the files of the repository by path. Raise MissingExtraError without ONNX."""
    onnx = import_extra("onnx", "onnx")
    answer = function(model)
    sheet = FunctionSheet.of(model, answer, origin)
    is_exact = bool(len(model.posterior.basis.outputs))
    kinds = {"float64": origin.model} if is_exact else {"float64": origin.model, "float32": f"{origin.model}-float32"}
    written = {}
    for dtype, name in kinds.items():
        written[f"{name}/config.pbtxt"] = _config(name, dtype, sheet, model.n_joints).encode()
        written[f"{name}/1/model.onnx"] = _graph(onnx, answer, sheet, name, dtype)
    listed = "".join(f"- `{name}`: {dtype}\n" for dtype, name in kinds.items())
    fields = {"stem": origin.stem, "models": listed, "count": len(sheet.self_test["q"])}
    text = README.format(single=NO_SINGLE if is_exact else SINGLE, **fields)
    return {"README.md": text.encode(), "self_test.json": sheet.json().encode(), **written}


def _config(name: str, dtype: str, sheet: FunctionSheet, n: int) -> str:
    """Return Triton's configuration."""
    kind = {"float64": "TYPE_FP64", "float32": "TYPE_FP32"}[dtype]
    parts = [("input", each, shape) for each, shape in sheet.arguments.items()]
    parts += [("output", each, (n,)) for each in RESULTS]
    tensors = "".join(
        f'{field} {{ name: "{each}" data_type: {kind} dims: [{", ".join(map(str, shape))}] }}\n'
        for field, each, shape in parts
    )
    return (
        f'name: "{name}"\nbackend: "onnxruntime"\nmax_batch_size: {MAX_BATCH}\n{tensors}'
        "dynamic_batching { max_queue_delay_microseconds: 100 }\n"
    )


def _graph(onnx: Any, answer: TorqueFunction, sheet: FunctionSheet, name: str, dtype: str) -> bytes:
    for batch in BATCHES:
        try:
            return _traced(onnx, answer, sheet, name, Graph(onnx.helper, dtype, batch))
        except BatchLengthError:
            continue
    raise ValueError("the model has axes of all example lengths of a batch")


def _traced(onnx: Any, answer: TorqueFunction, sheet: FunctionSheet, name: str, graph: Graph) -> bytes:
    """Return the serialised graph."""
    helper, kind = onnx.helper, onnx.helper.np_dtype_to_tensor_dtype(graph.dtype)
    given: list[Any] = [graph.argument(each, _repeated(sheet.self_test[each], graph.batch)) for each in sheet.arguments]
    traced: Any = answer(*given)
    for result, made in zip(RESULTS, traced, strict=True):
        graph.nodes.append(helper.make_node("Identity", [made.placed(True)], [result]))
    arguments = [
        helper.make_tensor_value_info(each, kind, ["batch", *shape]) for each, shape in sheet.arguments.items()
    ]
    results = [helper.make_tensor_value_info(each, kind, ["batch", given[0].shape[1]]) for each in RESULTS]
    stored = [
        onnx.numpy_helper.from_array(np.frombuffer(content, code).reshape(shape), each)
        for (code, shape, content), each in graph.constants.items()
    ]
    made_graph = helper.make_graph(graph.nodes, name, arguments, results, stored)
    opset = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(made_graph, opset_imports=opset, ir_version=IR_VERSION, producer_name="LIPServe")
    helper.set_model_props(model, {key: str(value) for key, value in sheet.about.items()})
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString())


def _repeated(values: Array, count: int) -> Array:
    return np.resize(values, (count, *values.shape[1:]))
