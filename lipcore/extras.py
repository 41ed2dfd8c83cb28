"""What can be installed besides the base, and the one place that imports it: whoever needs a module of an extra asks
here, when it is needed, and gets the module or an error that says what to install."""

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
"""Where the package example-robot-data puts URDFs, in a folder of packages: it has no module to be imported."""


@dataclass(frozen=True)
class Extra:
    """An extra, as pip takes it behind the name of the distribution.

    gives: what it is for, to be read after "to"; modules: those that it brings and that are imported here; folder: of
    data that it brings, below a folder of packages.
    """

    gives: str
    modules: tuple[str, ...]
    folder: str | None = None


EXTRAS = {
    "train": Extra("train the estimators se, gip and lse, on a GPU if there is one", ("torch",)),
    "robots": Extra("use URDFs", ("pinocchio",)),
    "sim": Extra("simulate robots and know them by name", ("pinocchio",), ROBOTS_DATA),
    "ingest": Extra("read CSV, Parquet, LeRobot and bags (NPZ and JSON need no extra)", ("pyarrow",)),
    "cluster": Extra("share PostgreSQL, S3 and a Dask cluster", ("psycopg", "s3fs", "distributed")),
    "grpc": Extra("answer over gRPC", ("grpc", "google.protobuf")),
    "opentelemetry": Extra("send traces", ("opentelemetry.exporter.otlp.proto.http",)),
    "plot": Extra("draw pictures", ("matplotlib",)),
}
"""All extras by name, as pyproject.toml has them."""


class MissingExtraError(RuntimeError):
    """Something is needed that is not installed; the message says how to install it.

    extra: its name, of EXTRAS; lacking: what is not there; reason: why it is needed, where that is not what the extra
    is for.
    """

    def __init__(self, extra: str, lacking: str, reason: str | None = None) -> None:
        needs = f"to {EXTRAS[extra].gives}, LIPServe" if reason is None else f"{reason}, which"
        super().__init__(f"{needs} needs {lacking}: {install_line(extra)}")
        self.extra, self.lacking, self.reason = extra, lacking, reason

    def __reduce__(self) -> tuple[type[MissingExtraError], tuple[str, str, str | None]]:
        """Its own arguments, where it comes from another process."""
        return type(self), (self.extra, self.lacking, self.reason)


def install_line(extra: str) -> str:
    """The line that installs an extra."""
    return "pip install " + shlex.quote(f"lipserve[{extra}]")


def need(module: str, extra: str, reason: str | None = None) -> Any:
    """Import a module of an extra; raise MissingExtraError where it cannot be."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise MissingExtraError(extra, _not_installed(error.name or module), reason) from error
    except ImportError as error:  # it is there, but a library of the system is not: libgomp1, for one
        raise MissingExtraError(extra, f"the module {module}, which cannot be imported ({error})", reason) from error


def need_folder(extra: str) -> Path:
    """The folder of data that an extra brings; raise MissingExtraError."""
    folder = EXTRAS[extra].folder
    assert folder is not None
    if (found := _folder(folder)) is None:
        raise MissingExtraError(extra, f"the files of {Path(folder).parts[-2]}, which are not installed")
    return found


def check(extra: str, reason: str | None = None) -> None:
    """Raise MissingExtraError unless all that an extra brings is installed; imports none of it."""
    for module in EXTRAS[extra].modules:
        if not _is_there(module):
            raise MissingExtraError(extra, _not_installed(module), reason)
    if EXTRAS[extra].folder is not None:
        need_folder(extra)


def installed(extra: str) -> bool:
    """Whether all that an extra brings is installed; imports none of it."""
    try:
        check(extra)
    except MissingExtraError:
        return False
    return True


def _not_installed(module: str) -> str:
    return f"the module {module}, which is not installed"


def _is_there(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # of the package that it is in
        return False


def _folder(below: str) -> Path | None:
    roots = [*site.getsitepackages(), site.getusersitepackages(), *sys.path]
    return next((folder for root in roots if (folder := Path(root) / below).is_dir()), None)
