"""The formats that a model is exported in, beside the archive."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from lipcore.export.c_writer import c_files
from lipcore.export.fitted_arm import fit_arm
from lipcore.export.jax_writer import jax_files
from lipcore.export.mjcf_writer import mjcf_text
from lipcore.export.onnx_writer import onnx_files
from lipcore.export.origin import ModelOrigin
from lipcore.export.sheet import Sheet
from lipcore.export.simulated_arm import SimulatedArm
from lipcore.export.torch_writer import torch_archive
from lipcore.export.urdf_writer import urdf_text
from lipcore.model.torque_model import TorqueModel
from lipcore.vocabulary import AUTO, ESTIMATOR_CHOICES, ROBOT_ESTIMATORS, ExportFormat

Writer = Callable[[TorqueModel, Mapping[str, Any], ModelOrigin], dict[str, bytes]]
"""Returns files by path. The second argument is `parameters` of the model's manifest. Raises ValueError for a model
that the format cannot express, and MissingExtraError if the format's library is missing."""


@dataclass(frozen=True)
class Format:
    """A format of one file, or of a folder of files."""

    write: Writer
    estimators: tuple[str, ...]
    """Estimators that it can express."""
    media_type: str | None = None
    """Type of its only file; None for a folder."""
    is_traced: bool = False
    """Whether a library traces the function, which takes seconds: run it in another process."""


def _arm(model: TorqueModel, parameters: Mapping[str, Any]) -> SimulatedArm:
    return fit_arm(model, SimulatedArm.of_parameters(parameters, model.joint_names, model.training_range))


def _write_urdf(model: TorqueModel, parameters: Mapping[str, Any], origin: ModelOrigin) -> dict[str, bytes]:
    arm = _arm(model, parameters)
    return {f"{origin.stem}.urdf": urdf_text(arm, origin.stem, Sheet.of(model, arm, origin)).encode()}


def _write_mjcf(model: TorqueModel, parameters: Mapping[str, Any], origin: ModelOrigin) -> dict[str, bytes]:
    arm = _arm(model, parameters)
    return {f"{origin.stem}.xml": mjcf_text(arm, origin.stem, Sheet.of(model, arm, origin, has_offset=True)).encode()}


def _write_c(model: TorqueModel, parameters: Mapping[str, Any], origin: ModelOrigin) -> dict[str, bytes]:
    return {name: text.encode() for name, text in c_files(model, origin).items()}


def _write_onnx(model: TorqueModel, _parameters: Mapping[str, Any], origin: ModelOrigin) -> dict[str, bytes]:
    return onnx_files(model, origin)


def _write_torch(model: TorqueModel, _parameters: Mapping[str, Any], origin: ModelOrigin) -> dict[str, bytes]:
    return {f"{origin.stem}.pt2": torch_archive(model, origin)}


def _write_jax(model: TorqueModel, _parameters: Mapping[str, Any], origin: ModelOrigin) -> dict[str, bytes]:
    return jax_files(model, origin)


_ALL = tuple(name for name in ESTIMATOR_CHOICES if name != AUTO)

FORMATS: dict[ExportFormat, Format] = {
    "urdf": Format(_write_urdf, ROBOT_ESTIMATORS, "application/xml"),
    "mjcf": Format(_write_mjcf, ROBOT_ESTIMATORS, "application/xml"),
    "c": Format(_write_c, ROBOT_ESTIMATORS),
    "onnx": Format(_write_onnx, _ALL, is_traced=True),
    "torch": Format(_write_torch, _ALL, "application/octet-stream", is_traced=True),
    "jax": Format(_write_jax, _ALL, is_traced=True),
}
"""All formats of `EXPORT_FORMATS` but the archive."""
