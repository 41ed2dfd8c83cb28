"""Messages of the protocol's gRPC service, as protobuf classes built from its published definition.

The classes are built at import in a descriptor pool of their own. No generated code or further package is needed, and
another copy of the definition, such as that of Triton's client, may be in the same process.
"""

from __future__ import annotations

import re
from typing import Any

from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

PACKAGE = "inference"
SERVICE = f"{PACKAGE}.GRPCInferenceService"
_DEFINITION = """
message ServerLiveRequest
message ServerLiveResponse
  bool live = 1
message ServerReadyRequest
message ServerReadyResponse
  bool ready = 1
message ModelReadyRequest
  string name = 1
  string version = 2
message ModelReadyResponse
  bool ready = 1
message ServerMetadataRequest
message ServerMetadataResponse
  string name = 1
  string version = 2
  repeated string extensions = 3
message ModelMetadataRequest
  string name = 1
  string version = 2
message ModelMetadataResponse
  string name = 1
  repeated string versions = 2
  string platform = 3
  repeated ModelMetadataResponse.TensorMetadata inputs = 4
  repeated ModelMetadataResponse.TensorMetadata outputs = 5
message ModelMetadataResponse.TensorMetadata
  string name = 1
  string datatype = 2
  repeated int64 shape = 3
message ModelInferRequest
  string model_name = 1
  string model_version = 2
  string id = 3
  parameters = 4
  repeated ModelInferRequest.InferInputTensor inputs = 5
  repeated ModelInferRequest.InferRequestedOutputTensor outputs = 6
  repeated bytes raw_input_contents = 7
message ModelInferRequest.InferInputTensor
  string name = 1
  string datatype = 2
  repeated int64 shape = 3
  parameters = 4
  InferTensorContents contents = 5
message ModelInferRequest.InferRequestedOutputTensor
  string name = 1
  parameters = 2
message ModelInferResponse
  string model_name = 1
  string model_version = 2
  string id = 3
  parameters = 4
  repeated ModelInferResponse.InferOutputTensor outputs = 5
  repeated bytes raw_output_contents = 6
message ModelInferResponse.InferOutputTensor
  string name = 1
  string datatype = 2
  repeated int64 shape = 3
  parameters = 4
  InferTensorContents contents = 5
message RepositoryIndexRequest
  string repository_name = 1
  bool ready = 2
message RepositoryIndexResponse
  repeated RepositoryIndexResponse.ModelIndex models = 1
message RepositoryIndexResponse.ModelIndex
  string name = 1
  string version = 2
  string state = 3
  string reason = 4
message RepositoryModelLoadRequest
  string repository_name = 1
  string model_name = 2
message RepositoryModelUnloadRequest
  string repository_name = 1
  string model_name = 2
message ModelConfigRequest
  string name = 1
  string version = 2
message ModelConfigResponse
  ModelConfig config = 1
message ModelConfig
  string name = 1
  string platform = 2
  string backend = 17
  int32 max_batch_size = 4
  repeated ModelInput input = 5
  repeated ModelOutput output = 6
  ModelTransactionPolicy model_transaction_policy = 19
message ModelInput
  string name = 1
  int32 data_type = 2
  repeated int64 dims = 4
  bool optional = 8
message ModelOutput
  string name = 1
  int32 data_type = 2
  repeated int64 dims = 3
message ModelTransactionPolicy
  bool decoupled = 1
message ModelStatisticsRequest
  string name = 1
  string version = 2
message ModelStatisticsResponse
  repeated ModelStatistics model_stats = 1
message ModelStatistics
  string name = 1
  string version = 2
  uint64 last_inference = 3
  uint64 inference_count = 4
  uint64 execution_count = 5
  InferStatistics inference_stats = 6
message InferStatistics
  StatisticDuration success = 1
  StatisticDuration fail = 2
  StatisticDuration queue = 3
  StatisticDuration compute_input = 4
  StatisticDuration compute_infer = 5
  StatisticDuration compute_output = 6
  StatisticDuration cache_hit = 7
  StatisticDuration cache_miss = 8
message StatisticDuration
  uint64 count = 1
  uint64 ns = 2
message InferParameter
  one bool bool_param = 1
  one int64 int64_param = 2
  one string string_param = 3
  one double double_param = 4
  one uint64 uint64_param = 5
message InferTensorContents
  repeated bool bool_contents = 1
  repeated int32 int_contents = 2
  repeated int64 int64_contents = 3
  repeated uint32 uint_contents = 4
  repeated uint64 uint64_contents = 5
  repeated float fp32_contents = 6
  repeated double fp64_contents = 7
  repeated bytes bytes_contents = 8
"""
"""The definition. `parameters` stands for a `map<string, InferParameter>`, `one` for `oneof parameter_choice`.

Messages of Triton's extensions have only the fields that are read or written; `data_type` is an enumeration there.
"""
_FIELD = re.compile(r"  (?:(?P<label>repeated|one) )?(?:(?P<type>[\w.]+) )?(?P<name>\w+) = (?P<number>\d+)")
_SCALARS = ("bool", "int32", "int64", "uint32", "uint64", "float", "double", "string", "bytes")


def _file() -> FileDescriptorProto:
    file = FileDescriptorProto(name="lipserve/open_inference.proto", package=PACKAGE, syntax="proto3")
    made: dict[str, DescriptorProto] = {}
    for line in _DEFINITION.strip().splitlines():
        if line.startswith("message "):
            outer, _, name = line.removeprefix("message ").rpartition(".")
            message = (made[outer].nested_type if outer else file.message_type).add(name=name)
            path = f"{outer}.{name}" if outer else name
            made[path] = message
        else:
            match = _FIELD.fullmatch(line)
            assert match is not None, line
            _add_field(message, path, match["label"], match["type"], match["name"], int(match["number"]))
    return file


def _add_field(
    message: DescriptorProto, path: str, label: str | None, kind: str | None, name: str, number: int
) -> None:
    if kind is None:  # a map, which protobuf represents as a list of entries
        entry = message.nested_type.add(name="ParametersEntry")
        entry.options.map_entry = True
        _add_field(entry, path, None, "string", "key", 1)
        _add_field(entry, path, None, "InferParameter", "value", 2)
        label, kind = "repeated", f"{path}.ParametersEntry"
    field = message.field.add(name=name, number=number)
    field.label = FieldDescriptorProto.LABEL_REPEATED if label == "repeated" else FieldDescriptorProto.LABEL_OPTIONAL
    if kind in _SCALARS:
        field.type = getattr(FieldDescriptorProto, f"TYPE_{kind.upper()}")
    else:
        field.type, field.type_name = FieldDescriptorProto.TYPE_MESSAGE, f".{PACKAGE}.{kind}"
    if label == "one":
        if not message.oneof_decl:
            message.oneof_decl.add(name="parameter_choice")
        field.oneof_index = 0


POOL = DescriptorPool()
POOL.Add(_file())


def message(name: str) -> Any:
    """Return the class of a message by its name, such as `ModelInferRequest`."""
    return GetMessageClass(POOL.FindMessageTypeByName(f"{PACKAGE}.{name}"))
