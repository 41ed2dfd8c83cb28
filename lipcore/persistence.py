"""A model on disk: `manifest.json`, which a person can read, `model.safetensors`, and `robot.urdf` where there is one.

None of them can hold code.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors

from lipcore.calibration import Calibration
from lipcore.compact.statistics import Statistics
from lipcore.model import TORQUE_CONVENTIONS, TorqueModel, restore
from lipcore.motion import Motion
from lipcore.parameters import report
from lipcore.urdf import RigidBody

FORMAT = "lipserve-model"
FORMAT_VERSION = 3
MANIFEST, TENSORS, ROBOT = "manifest.json", "model.safetensors", "robot.urdf"


class ModelFormatError(ValueError):
    """A folder does not hold a valid model; the message names what is wrong."""


def save(model: TorqueModel, folder: Path, lineage: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Write the model as a new folder, all of it or nothing, and return its manifest.

    lineage: where the model comes from, stored as given. Raise FileExistsError where the folder exists, ValueError for
    a model that has learnt online: what it has learnt is no part of the version.
    """
    if folder.exists():
        raise FileExistsError(f"{folder} exists: a saved model is never overwritten")
    basis, statistics = model.posterior.basis, model.posterior.statistics
    if statistics is None:
        raise ValueError("the model has learnt online since it was trained, expected one as trained")
    tensors = {f"params/{name}": value for name, value in model.posterior.params.items()}
    tensors |= {f"inducing/{name}": getattr(basis.inducing, name) for name in ("q", "dq", "ddq")}
    tensors |= {
        "inducing/outputs": basis.outputs,
        "statistics/a": pack_symmetric(statistics.a),
        "statistics/b": statistics.b,
    }
    payload = save_tensors({name: value.contiguous() for name, value in tensors.items()})
    manifest = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "estimator": model.estimator.name,
        "joint_names": list(model.joint_names),
        "joint_types": list(model.joint_types),
        "torque_convention": model.torque_convention,
        "noise_std": model.noise_std.tolist(),
        "options": model.options,
        "fit": model.fit,
        "compact": {**model.compact, "data_samples": round(statistics.samples)},
        "calibration": asdict(model.calibration),
        "parameters": report(model.posterior, model.estimator),
        "training_range": model.training_range,
        "lineage": dict(lineage or {}),
        "tensors": {"file": TENSORS, "bytes": len(payload), "sha256": hashlib.sha256(payload).hexdigest()},
    }
    files = {TENSORS: payload}
    if model.robot is not None:
        urdf = model.robot.urdf.encode()
        files[ROBOT] = urdf
        manifest["robot"] = {
            "name": model.robot.name,
            "joints": list(model.robot.urdf_joints),
            "matched": model.robot.matched,
            "prior": model.options["prior"],
            "file": ROBOT,
            "bytes": len(urdf),
            "sha256": model.robot.sha256,
        }
    _write_folder(folder, {**files, MANIFEST: json.dumps(manifest, indent=2, allow_nan=False).encode() + b"\n"})
    return manifest


def copy_model(source: Path, folder: Path) -> dict[str, Any]:
    """Copy a saved model to a new folder, all of it or nothing, and return its manifest; raise ModelFormatError."""
    manifest = read_manifest(source)
    files = {TENSORS: _read_tensors(source, manifest)}
    if "robot" in manifest:
        files[ROBOT] = _read_urdf(source, manifest)
    _write_folder(folder, {**files, MANIFEST: (source / MANIFEST).read_bytes()})
    return manifest


def read_manifest(folder: Path) -> dict[str, Any]:
    """Read and check a model's manifest; raise ModelFormatError."""
    try:
        manifest = json.loads((folder / MANIFEST).read_bytes())
    except (OSError, ValueError) as error:
        raise ModelFormatError(f"{folder / MANIFEST} cannot be read: {error}") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ModelFormatError(f"{folder / MANIFEST} is not a manifest of format {FORMAT!r}")
    if manifest.get("format_version") != FORMAT_VERSION:
        found = manifest.get("format_version")
        raise ModelFormatError(f"format_version is {found!r}, expected {FORMAT_VERSION}: train the model again")
    kinds: dict[str, type] = {"estimator": str, "joint_names": list, "joint_types": list}
    kinds |= dict.fromkeys(("options", "fit", "compact", "calibration", "training_range", "tensors"), dict)
    for name, kind in kinds.items():
        if not isinstance(manifest.get(name), kind):
            raise ModelFormatError(f"{name} is {manifest.get(name)!r}, expected a {kind.__name__}")
    if manifest.get("torque_convention") not in TORQUE_CONVENTIONS:
        raise ModelFormatError(f"torque_convention is {manifest.get('torque_convention')!r}")
    if not isinstance(manifest.get("robot", {}), dict):
        raise ModelFormatError(f"robot is {manifest['robot']!r}, expected a dict")
    return manifest


def load(folder: Path) -> TorqueModel:
    """Load a model that `save` wrote; raise ModelFormatError for anything else."""
    manifest = read_manifest(folder)
    payload = _read_tensors(folder, manifest)
    try:
        tensors = load_tensors(payload)
        outputs = tensors.pop("inducing/outputs")
        if outputs.dtype != torch.int64:
            raise ValueError(f"tensor 'inducing/outputs' is of {outputs.dtype}, expected int64")
        for name, value in tensors.items():
            if value.dtype != torch.float64 or not torch.isfinite(value).all():
                raise ValueError(f"tensor {name!r} is not made of finite float64 numbers")
        inducing = {name: tensors.pop(f"inducing/{name}") for name in ("q", "dq", "ddq")}
        n = len(manifest["joint_names"])
        for name, value in inducing.items():
            if value.dim() != 2 or value.shape != inducing["q"].shape or value.shape[1] != n:
                raise ValueError(f"inducing/{name} has shape {tuple(value.shape)}, expected (S, {n})")
        a, b = unpack_symmetric("statistics/a", tensors.pop("statistics/a")), tensors.pop("statistics/b")
        compact = dict(manifest["compact"])
        statistics = Statistics(a, b, float(compact.pop("data_samples")))
        return restore(
            manifest["estimator"],
            manifest["joint_names"],
            manifest["joint_types"],
            manifest["torque_convention"],
            manifest["options"],
            manifest["fit"],
            {name.removeprefix("params/"): value for name, value in tensors.items()},
            Motion(**inducing),
            outputs,
            statistics,
            manifest["training_range"],
            compact,
            _read_robot(folder, manifest),
            Calibration(**manifest["calibration"]),
        )
    except ModelFormatError:
        raise
    except Exception as error:
        raise ModelFormatError(f"{folder} does not hold a valid model: {error}") from error


def pack_symmetric(symmetric: torch.Tensor) -> torch.Tensor:
    """Upper triangle of a symmetric matrix (M, M), row by row: (M (M + 1) / 2,)."""
    rows, columns = torch.triu_indices(*symmetric.shape)
    return symmetric[rows, columns]


def unpack_symmetric(name: str, packed: torch.Tensor) -> torch.Tensor:
    """Inverse of `pack_symmetric`; raise ValueError for a length that no triangle has."""
    size = math.isqrt(2 * packed.numel())
    if packed.dim() != 1 or size * (size + 1) // 2 != len(packed):
        raise ValueError(f"{name} has shape {tuple(packed.shape)}, expected M (M + 1) / 2 numbers")
    rows, columns = torch.triu_indices(size, size)
    full = torch.empty((size, size), dtype=packed.dtype)
    full[rows, columns] = full[columns, rows] = packed
    return full


def _read_tensors(folder: Path, manifest: Mapping[str, Any]) -> bytes:
    try:
        payload = (folder / TENSORS).read_bytes()
    except OSError as error:
        raise ModelFormatError(f"{folder / TENSORS} cannot be read: {error}") from error
    if hashlib.sha256(payload).hexdigest() != manifest["tensors"].get("sha256"):
        raise ModelFormatError(f"{folder / TENSORS} does not match the sha256 of its manifest")
    return payload


def _read_urdf(folder: Path, manifest: Mapping[str, Any]) -> bytes:
    try:
        urdf = (folder / ROBOT).read_bytes()
    except OSError as error:
        raise ModelFormatError(f"{folder / ROBOT} cannot be read: {error}") from error
    if hashlib.sha256(urdf).hexdigest() != manifest["robot"].get("sha256"):
        raise ModelFormatError(f"{folder / ROBOT} does not match the sha256 of its manifest")
    return urdf


def _read_robot(folder: Path, manifest: Mapping[str, Any]) -> RigidBody | None:
    if "robot" not in manifest:
        return None
    entry, urdf = manifest["robot"], _read_urdf(folder, manifest).decode()
    robot = RigidBody.from_urdf(
        urdf, manifest["joint_names"], manifest["joint_types"], list(entry["joints"]), str(entry["name"])
    )
    return replace(robot, matched=entry["matched"])


def _write_folder(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write all files to a draft beside `folder`, then rename it: readers see all or nothing."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    draft = Path(tempfile.mkdtemp(prefix=".draft-", dir=folder.parent))
    try:
        for name, content in files.items():
            _write(draft / name, content)
        draft.chmod(0o755)
        _sync(draft)
        os.rename(draft, folder)
        _sync(folder.parent)
    except BaseException:
        shutil.rmtree(draft, ignore_errors=True)
        raise


def _write(path: Path, content: bytes) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _sync(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
