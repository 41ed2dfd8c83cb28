"""The service, and what the Open Inference Protocol tells of it. Written by `python clients/python/records.py`."""

from __future__ import annotations

from typing import Any, Literal

from msgspec import field

from lipserve.records import Record


class Missing(Record, frozen=True, kw_only=True):
    """What the service cannot do for want of an extra.

    gives: What it is for, in words
    install: What installs it, where the service runs
    """

    extra: str
    gives: str
    install: str


class Health(Record, frozen=True, kw_only=True):
    """The process answers, and what it can do.

    can: What is installed besides serving, teaching and training of learnt arms, by the name of its extra: `train`, to
        train the estimators se, gip and lse, on a GPU if there is one; `robots`, to use URDFs; `sim`, to simulate
        robots and know them by name; `ingest`, to read CSV, Parquet, LeRobot and bags (NPZ and JSON need no extra);
        `cluster`, to share PostgreSQL, S3 and a Dask cluster; `grpc`, to answer over gRPC; `opentelemetry`, to send
        traces; `plot`, to draw pictures
    missing: Of what is not installed
    confined: What this system has to keep the process in which an upload is read from harm: limits of `memory` and
        `processor`; `landlock`, from files; `seccomp`, from the network and other processes
    """

    status: Literal["alive"] = "alive"
    version: str
    can: dict[str, bool]
    missing: list[Missing]
    confined: dict[str, bool] = field(default_factory=dict)


class Live(Record, frozen=True, kw_only=True):
    """The process answers."""

    status: Literal["alive"] = "alive"


class Part(Record, frozen=True, kw_only=True):
    """One part of the service.

    state: warning: some clients may notice something
    """

    name: str
    state: Literal["ok", "warning"]
    message: str


class Ready(Record, frozen=True, kw_only=True):
    """The service can do what it is for."""

    status: Literal["ready"] = "ready"
    version: str
    checks: list[Part]


class ServerMetadata(Record, frozen=True, kw_only=True):
    """What serves, and which extensions of the protocol it speaks."""

    name: str
    version: str
    extensions: list[str]


class ServerLive(Record, frozen=True, kw_only=True):
    """The process answers."""

    live: Literal[True] = True


class ServerReady(Record, frozen=True, kw_only=True):
    """The service can answer queries."""

    ready: Literal[True] = True


class TensorMetadata(Record, frozen=True, kw_only=True):
    """A tensor of a model. -1 stands for the number of queries N; an input of one query may leave this axis out.

    datatype: Inputs may also be FP32
    parameters: `optional`: an input that only some outputs need
    """

    name: str
    datatype: Literal["FP64"] = "FP64"
    shape: list[int]
    parameters: dict[str, Any] | None = None


class ModelMetadata(Record, frozen=True, kw_only=True):
    """The tensors of a model and its versions.

    versions: Versions that a path may name; without one the latest answers
    platform: `lipserve_` and the estimator
    parameters: `version` and `revision` described here, `torque_convention`, and `joint_names`, joined by commas
    """

    name: str
    versions: list[str]
    platform: str
    inputs: list[TensorMetadata]
    outputs: list[TensorMetadata]
    parameters: dict[str, Any]


class ModelReady(Record, frozen=True, kw_only=True):
    """The version is in memory and answers."""

    name: str
    ready: Literal[True] = True
