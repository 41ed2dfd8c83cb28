"""State of the service, and answers of the Open Inference Protocol. Written by `python clients/python/records.py`."""

from __future__ import annotations

from typing import Any, Literal

from msgspec import field

from lipserve.records import Record


class Missing(Record, frozen=True, kw_only=True):
    """An extra that is not installed.

    gives: Purpose of the extra
    install: Command that installs it, to be run where the service runs
    """

    extra: str
    gives: str
    install: str


class Health(Record, frozen=True, kw_only=True):
    """The process is running, and its capabilities.

    can: Installed extras by name, besides serving, online learning and training of learnt arms: `train`, to train the
        estimators se, gip and lse, on a GPU if there is one; `robots`, to use URDFs; `sim`, to simulate robots and know
        them by name; `ingest`, to read CSV, Parquet, HDF5, Excel, LeRobot and bags (NPZ and JSON need no extra);
        `cluster`, to share PostgreSQL, S3 and a Dask cluster; `grpc`, to serve over gRPC; `opentelemetry`, to send
        traces; `onnx`, to export ONNX; `jax`, to export functions of JAX; `plot`, to draw pictures
    missing: Extras that are not installed
    confined: Available confinement of the process that reads uploads: limits of `memory` and `processor` time;
        `landlock` blocks files; `seccomp` blocks the network and other processes
    """

    status: Literal["alive"] = "alive"
    version: str
    can: dict[str, bool]
    missing: list[Missing]
    confined: dict[str, bool] = field(default_factory=dict)


class Live(Record, frozen=True, kw_only=True):
    """The process is running."""

    status: Literal["alive"] = "alive"


class Part(Record, frozen=True, kw_only=True):
    """One part of the service.

    state: `warning`: some clients may be affected
    """

    name: str
    state: Literal["ok", "warning"]
    message: str


class Ready(Record, frozen=True, kw_only=True):
    """The service is ready."""

    status: Literal["ready"] = "ready"
    version: str
    checks: list[Part]


class ServerMetadata(Record, frozen=True, kw_only=True):
    """Name and version of the server, and the supported extensions of the protocol."""

    name: str
    version: str
    extensions: list[str]


class ServerLive(Record, frozen=True, kw_only=True):
    """The process is alive."""

    live: Literal[True] = True


class ServerReady(Record, frozen=True, kw_only=True):
    """The service can answer queries."""

    ready: Literal[True] = True


class TensorMetadata(Record, frozen=True, kw_only=True):
    """A tensor of a model. -1 stands for the number of queries N; the inputs of a single query may omit this axis.

    datatype: Inputs may also be FP32
    parameters: `optional`: only some outputs need this input
    """

    name: str
    datatype: Literal["FP64"] = "FP64"
    shape: list[int]
    parameters: dict[str, Any] | None = None


class ModelMetadata(Record, frozen=True, kw_only=True):
    """Tensors and versions of a model.

    versions: Versions that a path may name; without one, the serving version answers
    platform: `lipserve_` and the name of the estimator
    parameters: `version` and `revision` described here, `torque_convention`, and `joint_names`, comma-separated
    """

    name: str
    versions: list[str]
    platform: str
    inputs: list[TensorMetadata]
    outputs: list[TensorMetadata]
    parameters: dict[str, Any]


class ModelReady(Record, frozen=True, kw_only=True):
    """The version is in memory and can answer."""

    name: str
    ready: Literal[True] = True
