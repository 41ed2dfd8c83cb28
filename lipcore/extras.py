"""The optional dependencies, and the one place that imports them.

Code that needs a module of an extra calls `import_extra` when it needs it. It gets the module, or an error with the
command that installs it.
"""

from __future__ import annotations

import shlex
import site
import sys
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

ROBOTS_DATA = "cmeel.prefix/share/example-robot-data/robots"
"""Folder of URDFs in an installation of example-robot-data, which has no module to import."""


@dataclass(frozen=True)
class Extra:
    """An optional dependency of the distribution, by its name in pip."""

    gives: str
    """Its purpose, as words after "to"."""
    modules: tuple[str, ...]
    """Modules that it installs and that are imported here."""
    folder: str | None = None
    """Folder of data that it installs, below a folder of packages."""


EXTRAS = {
    "train": Extra("train the estimators se, gip and lse, on a GPU if there is one", ("torch",)),
    "robots": Extra("use URDFs", ("pinocchio", "xacro")),
    "sim": Extra("simulate robots and know them by name", ("pinocchio",), ROBOTS_DATA),
    "ingest": Extra(
        "read CSV, Parquet, HDF5, Excel, LeRobot and bags (NPZ and JSON need no extra)",
        ("pyarrow", "clevercsv", "chardet", "dateutil", "h5py", "openpyxl", "rosbags", "mcap", "mcap_protobuf", "yaml"),
    ),
    "cluster": Extra("share PostgreSQL, S3 and a Dask cluster", ("psycopg", "s3fs", "distributed")),
    "grpc": Extra("serve over gRPC", ("grpc", "google.protobuf")),
    "opentelemetry": Extra("send traces", ("opentelemetry.exporter.otlp.proto.http",)),
    "onnx": Extra("export ONNX", ("onnx",)),
    "jax": Extra("export functions of JAX", ("jax",)),
    "plot": Extra("draw pictures", ("matplotlib",)),
}
"""All extras by name, as in pyproject.toml."""


class MissingExtraError(RuntimeError):
    """A module or folder is not installed; the message has the command that installs it.

    extra: a name of EXTRAS; lacking: what is missing; reason: why it is needed, if not for the purpose of the extra.
    """

    def __init__(self, extra: str, lacking: str, reason: str | None = None) -> None:
        needs = f"to {EXTRAS[extra].gives}, LIPServe" if reason is None else f"{reason}, which"
        super().__init__(f"{needs} needs {lacking}: {install_line(extra)}")
        self.extra, self.lacking, self.reason = extra, lacking, reason

    def __reduce__(self) -> tuple[type[MissingExtraError], tuple[str, str, str | None]]:
        """Return its own arguments, to unpickle it in another process."""
        return type(self), (self.extra, self.lacking, self.reason)


def install_line(extra: str) -> str:
    """Return the command that installs an extra."""
    return "pip install " + shlex.quote(f"lipserve[{extra}]")


def import_extra(module: str, extra: str, reason: str | None = None) -> Any:
    """Import and return a module of an extra; raise MissingExtraError if that fails."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise MissingExtraError(extra, _not_installed(error.name or module), reason) from error
    except ImportError as error:  # the module is installed, but not a system library, such as libgomp1
        raise MissingExtraError(extra, f"the module {module}, which cannot be imported ({error})", reason) from error


def find_data_folder(extra: str) -> Path:
    """Return the folder of data that an extra installs; raise MissingExtraError if it is missing."""
    folder = EXTRAS[extra].folder
    assert folder is not None
    if (found := _folder(folder)) is None:
        raise MissingExtraError(extra, f"the files of {Path(folder).parts[-2]}, which are not installed")
    return found


def check_extra(extra: str, reason: str | None = None) -> None:
    """Raise MissingExtraError unless all modules and data of an extra are installed; imports none of them."""
    for module in EXTRAS[extra].modules:
        if not _is_there(module):
            raise MissingExtraError(extra, _not_installed(module), reason)
    if EXTRAS[extra].folder is not None:
        find_data_folder(extra)


def is_installed(extra: str) -> bool:
    """Return whether all modules and data of an extra are installed; imports none of them."""
    try:
        check_extra(extra)
    except MissingExtraError:
        return False
    return True


def _not_installed(module: str) -> str:
    return f"the module {module}, which is not installed"


def _is_there(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # its package is missing
        return False


def _folder(below: str) -> Path | None:
    roots = [*site.getsitepackages(), site.getusersitepackages(), *sys.path]
    return next((folder for root in roots if (folder := Path(root) / below).is_dir()), None)
