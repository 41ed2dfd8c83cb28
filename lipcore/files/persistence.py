"""A model on disk: a readable `manifest.json`, `model.safetensors`, and `robot.urdf` if the model has a robot.

None of them can contain code. All their content is checked, because a model may come from an untrusted source.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save as save_tensors

from lipcore.data.motion import Array, Indices, Motion
from lipcore.estimators.catalogue import Calibration, make_estimator
from lipcore.files.arm import arm_tensors, is_arm_tensor, read_arm
from lipcore.files.durable import make_folder, sync_folder
from lipcore.files.manifest import (
    DEFAULT_LIMITS,
    FORMAT,
    FORMAT_VERSION,
    MANIFEST,
    ROBOT,
    TENSORS,
    Limits,
    ModelFormatError,
    read_manifest_bytes,
)
from lipcore.files.residual import read_residual, residual_tensors
from lipcore.files.tensors import FLOOR, INDUCING, MISFIT, OUTPUTS, PARAMS, A, B, read_tensors
from lipcore.kernels.arm_prior import Arm
from lipcore.model.parameters import report
from lipcore.model.torque_model import TorqueModel
from lipcore.model.warnings import warnings
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.conformal import Conformal
from lipcore.posterior.linalg import pack_symmetric, unpack_symmetric
from lipcore.posterior.misfit import Misfit
from lipcore.posterior.statistics import Statistics
from lipcore.robots.urdf import RigidBody
from lipcore.vocabulary import GEOMETRY_MODES, LOCAL, ROBOT_ESTIMATORS


def save(model: TorqueModel, folder: Path, lineage: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Write the model as a new folder, completely or not at all, and return its manifest.

    Args:
        model: a model as trained.
        folder: the folder to make.
        lineage: origin of the model, stored as given.

    Returns:
        The manifest, as `manifest.json` contains it.

    Raises:
        FileExistsError: The folder exists.
        ValueError: The model has learnt online: see `lipcore.online.transfer`.

    Example:
        >>> manifest = lipcore.save(model, Path("models/my-arm"))
        >>> lipcore.load("models/my-arm").joint_names == tuple(manifest["joint_names"])
        True

    """
    manifest, files = encode(model, lineage)
    write_folder(folder, files)
    return manifest


def encode(model: TorqueModel, lineage: Mapping[str, Any] | None = None) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Return the manifest of a model and its files by name: `manifest.json`, `model.safetensors`, `robot.urdf`.

    lineage: origin of the model, stored as given. Raise ValueError as `save` does.
    """
    basis, statistics = model.posterior.basis, model.posterior.statistics
    if statistics is None:
        raise ValueError("the model has learnt online, expected a model as trained")
    tensors: dict[str, Array | Indices] = {f"{PARAMS}{name}": value for name, value in model.posterior.params.items()}
    tensors |= {name: getattr(basis.inducing, name.rpartition("/")[2]) for name in INDUCING}
    tensors |= {OUTPUTS: basis.outputs, A: pack_symmetric(statistics.a), B: statistics.b}
    if bool((model.posterior.floor > 0).any()):
        tensors[FLOOR] = model.posterior.floor
    if model.posterior.misfit.is_nonzero:
        tensors[MISFIT] = model.posterior.misfit.packed()
    if model.arm is not None:
        tensors |= arm_tensors(model.arm)
    if basis.residual is not None:
        tensors |= residual_tensors(basis.residual)
    parameters = report(model.posterior, model.estimator, model.joint_names)
    payload = save_tensors({name: np.asarray(value, order="C") for name, value in tensors.items()})
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
        "parameters": parameters,
        "warnings": warnings(model, parameters),
        "hyperparameters": {name: value.tolist() for name, value in model.posterior.params.items()},
        "training_range": model.training_range,
        "lineage": dict(lineage or {}),
        "tensors": {"file": TENSORS, "bytes": len(payload), "sha256": sha256(payload)},
    }
    if model.selection is not None:
        manifest["selection"] = model.selection
    if model.training_torque is not None:
        manifest["training_torque"] = model.training_torque
    if model.conformal is not None:
        manifest["conformal"] = {
            name: each if name == "blocks" else list(each) for name, each in vars(model.conformal).items()
        }
    files = {TENSORS: payload}
    if model.robot is not None:
        files[ROBOT] = model.robot.urdf.encode()
        manifest["robot"] = {
            "name": model.robot.name,
            "joints": list(model.robot.urdf_joints),
            "matched": model.robot.matched,
            "prior": model.options["prior"],
            "file": ROBOT,
            "bytes": len(files[ROBOT]),
            "sha256": sha256(files[ROBOT]),
        }
    files[MANIFEST] = manifest_bytes(manifest)
    read_manifest_bytes(files[MANIFEST])  # writes nothing that reading would reject
    return manifest, files


def decode(files: Mapping[str, bytes], limits: Limits = DEFAULT_LIMITS) -> TorqueModel:
    """Return the model in these files; raise ModelFormatError for anything that `encode` does not write.

    The limits bound its cost in time and memory. They are checked before anything is computed.
    """
    manifest, tensors, robot = parse(files, limits)
    try:
        # the checks that follow reject overflows of untrusted numbers
        with np.errstate(over="ignore", invalid="ignore"):
            return _restore(manifest, tensors, robot)
    except ModelFormatError:
        raise
    except Exception as error:  # numerics may raise any error for numbers that no training has made
        raise ModelFormatError(f"the tensors do not make a valid model: {_text(error)}", TENSORS) from error


def parse(
    files: Mapping[str, bytes], limits: Limits = DEFAULT_LIMITS
) -> tuple[dict[str, Any], dict[str, Array], RigidBody | None]:
    """Return the manifest, the tensors and the robot in these files; raise ModelFormatError."""
    manifest = _manifest(files, limits)
    tensors = read_tensors(_verified(files, TENSORS, manifest["tensors"]), len(manifest["joint_names"]), limits)
    return manifest, tensors, _robot(files, manifest, limits)


def load(
    folder: Path | str, checksums: Mapping[str, str] | None = None, limits: Limits = DEFAULT_LIMITS
) -> TorqueModel:
    """Return the model that `save` wrote.

    Args:
        folder: the folder of the model.
        checksums: expected sha256 of each file by name, from another source.
        limits: max size of the model.

    Raises:
        ModelFormatError: The files are not a valid model, or do not match the checksums.

    Example:
        >>> model = lipcore.load("models/my-arm")
        >>> model.predict(q, dq, ddq).tau.shape == q.shape
        True

    """
    files = read_files(Path(folder), limits)
    if checksums is not None:
        check_checksums(files, checksums)
    try:
        return decode(files, limits)
    except ModelFormatError as error:
        raise ModelFormatError(f"{folder} does not hold a valid model: {error}", error.file) from error


def copy_model(source: Path, folder: Path) -> dict[str, Any]:
    """Copy a saved model to a new folder, completely or not at all, and return its manifest.

    Args:
        source: the folder of the model.
        folder: the folder to make.

    Returns:
        The manifest of the model.

    Raises:
        FileExistsError: The new folder exists.
        ModelFormatError: The files are not a valid model.

    Example:
        >>> lipcore.copy_model(Path("models/my-arm"), Path("backup/my-arm"))["format"]
        'lipserve-model'

    """
    files = read_files(source)
    manifest = _manifest(files, DEFAULT_LIMITS)
    _verified(files, TENSORS, manifest["tensors"])
    if "robot" in manifest:
        _verified(files, ROBOT, manifest["robot"])
    write_folder(folder, {**files, MANIFEST: manifest_bytes(manifest)})
    return manifest


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return a model's checked manifest; raise ModelFormatError."""
    return read_manifest_bytes(_read(folder / MANIFEST, DEFAULT_LIMITS.manifest_bytes))


def read_files(folder: Path, limits: Limits = DEFAULT_LIMITS) -> dict[str, bytes]:
    """Return the unchecked files of a saved model by name; raise ModelFormatError if one is missing."""
    files = {MANIFEST: _read(folder / MANIFEST, limits.manifest_bytes)}
    files[TENSORS] = _read(folder / TENSORS)
    if "robot" in _manifest(files, limits):
        files[ROBOT] = _read(folder / ROBOT, limits.robot_bytes)
    return files


def check_checksums(files: Mapping[str, bytes], checksums: Mapping[str, str]) -> None:
    """Compare files by name with their expected sha256.

    Raise ModelFormatError naming the file that is missing, unexpected, or damaged.
    """
    for name in sorted(files.keys() | checksums.keys()):
        if name not in files or name not in checksums:
            raise ModelFormatError(f"{name} is {'missing' if name in checksums else 'unexpected'}", name)
        if sha256(files[name]) != checksums[name]:
            raise ModelFormatError(f"{name} is damaged: it does not match its stored sha256", name)


def checksums(manifest: Mapping[str, Any]) -> dict[str, str]:
    """Return the sha256 of each file of the model with this manifest, by name."""
    sums = {MANIFEST: sha256(manifest_bytes(manifest)), TENSORS: str(manifest["tensors"]["sha256"])}
    return {**sums, ROBOT: str(manifest["robot"]["sha256"])} if "robot" in manifest else sums


def manifest_bytes(manifest: Mapping[str, Any]) -> bytes:
    """Return the file of a manifest: equal manifests return equal bytes."""
    return json.dumps(manifest, indent=2, allow_nan=False).encode() + b"\n"


def sha256(content: bytes) -> str:
    """Return the hash of a file, in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def write_folder(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files as a new folder that survives a power cut, completely or not at all.

    Raise FileExistsError if the folder exists.
    """
    if folder.exists():
        raise FileExistsError(f"{folder} exists: a saved model is never overwritten")
    make_folder(folder.parent)
    # if nobody removes the draft, its name identifies it
    draft = Path(tempfile.mkdtemp(prefix=f".draft-{folder.name}-", dir=folder.parent))
    try:
        for name, content in files.items():
            _write(draft / name, content)
        draft.chmod(0o755)
        sync_folder(draft)
        os.rename(draft, folder)
        sync_folder(folder.parent)
    except BaseException:
        shutil.rmtree(draft, ignore_errors=True)
        raise


def _manifest(files: Mapping[str, bytes], limits: Limits) -> dict[str, Any]:
    if MANIFEST not in files:
        raise ModelFormatError(f"{MANIFEST} is missing")
    return read_manifest_bytes(files[MANIFEST], limits)


def _verified(files: Mapping[str, bytes], name: str, entry: Mapping[str, Any]) -> bytes:
    """Return a file that has the size and the hash of its manifest entry."""
    if name not in files:
        raise ModelFormatError(f"{name} is missing", name)
    content = files[name]
    if len(content) != entry["bytes"] or sha256(content) != entry["sha256"]:
        raise ModelFormatError(f"{name} does not match the sha256 and the size of its manifest", name)
    return content


def _robot(files: Mapping[str, bytes], manifest: Mapping[str, Any], limits: Limits) -> RigidBody | None:
    if "robot" not in manifest:
        return None
    entry = manifest["robot"]
    content = _verified(files, ROBOT, entry)
    if len(content) > limits.robot_bytes:
        raise ModelFormatError(f"{ROBOT} has {len(content)} bytes, expected at most {limits.robot_bytes}", ROBOT)
    try:
        robot = RigidBody.from_urdf(
            content.decode(), manifest["joint_names"], manifest["joint_types"], entry["joints"], entry["name"]
        )
    except Exception as error:  # Pinocchio raises any error of its parser
        raise ModelFormatError(f"{ROBOT} is not the robot of this model: {_text(error)}", ROBOT) from error
    return replace(robot, matched=entry["matched"])


def _restore(manifest: Mapping[str, Any], tensors: dict[str, Array], robot: RigidBody | None) -> TorqueModel:
    params = {name.removeprefix(PARAMS): value for name, value in tensors.items() if name.startswith(PARAMS)}
    compact = dict(manifest["compact"])
    statistics = Statistics(unpack_symmetric(A, tensors[A]), tensors[B], float(compact.pop("data_samples")))
    arm = _arm(manifest, tensors) if manifest["estimator"] in ROBOT_ESTIMATORS else None
    if arm is None and (strange := next(filter(is_arm_tensor, tensors), None)) is not None:
        raise ModelFormatError(f"{TENSORS} has the tensor {strange!r}, but the estimator has no rigid bodies", TENSORS)
    options, calibration = manifest["options"], Calibration(**manifest["calibration"])
    residual = read_residual(tensors)
    if (residual is None) == (manifest["estimator"] == LOCAL):
        raise ModelFormatError(f"{TENSORS} must have the tensors of a local correction for {LOCAL} alone", TENSORS)
    estimator = make_estimator(manifest["estimator"], manifest["joint_types"], bool(options.get("tied", True)), arm)
    estimator = estimator if residual is None else estimator.corrected(residual)
    misfit = Misfit.unpacked(tensors[MISFIT]) if MISFIT in tensors else None
    if (misfit is not None and misfit.elements.size > 0) != (arm is not None and "play" in arm.drive):
        raise ModelFormatError(f"tensor {MISFIT!r} needs rows of play elements if friction has play", TENSORS)
    posterior = CompactPosterior.restore(
        estimator.kernel,
        params,
        Motion(*(tensors[name] for name in INDUCING)),
        tensors[OUTPUTS].astype(np.int64),
        statistics,
        float(manifest["fit"].get("jitter", 0.0)),
        calibration.function_std_factor,
        misfit,
    )
    if FLOOR in tensors:
        posterior = replace(posterior, floor=tensors[FLOOR])
    model = TorqueModel(
        estimator=estimator,
        joint_names=tuple(manifest["joint_names"]),
        joint_types=tuple(manifest["joint_types"]),
        torque_convention=manifest["torque_convention"],
        options=options,
        fit=manifest["fit"],
        posterior=posterior,
        training_range=manifest["training_range"],
        compact=compact,
        robot=robot,
        calibration=calibration,
        selection=manifest.get("selection"),
        conformal=Conformal(**manifest["conformal"]) if "conformal" in manifest else None,
        training_torque=manifest.get("training_torque"),
    )
    if manifest["hyperparameters"] != {name: value.tolist() for name, value in params.items()}:
        raise ModelFormatError("hyperparameters are not those of the tensors")
    # another processor may round differently
    if not np.allclose(model.noise_std, manifest["noise_std"], rtol=1e-6, atol=0):
        raise ModelFormatError(f"noise_std is not that of the tensors, {model.noise_std.tolist()}")
    return model


def _arm(manifest: Mapping[str, Any], tensors: Mapping[str, Array]) -> Arm:
    if "geometry" not in manifest["fit"]:
        raise ModelFormatError(f"fit.geometry is missing, expected one of {', '.join(GEOMETRY_MODES)}")
    try:
        return read_arm(tensors, manifest["joint_types"], manifest["fit"]["geometry"])
    except ValueError as error:
        raise ModelFormatError(str(error), TENSORS) from None


def _text(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__)[:300]


def _read(path: Path, max_bytes: int | None = None) -> bytes:
    """Return a file of a saved model; raise ModelFormatError, also for more than `max_bytes`."""
    try:
        with path.open("rb") as file:
            content = file.read(-1 if max_bytes is None else max_bytes + 1)
    except OSError as error:
        raise ModelFormatError(f"{path} cannot be read: {error}", path.name) from error
    if max_bytes is not None and len(content) > max_bytes:
        raise ModelFormatError(f"{path} has more than {max_bytes} bytes", path.name)
    return content


def _write(path: Path, content: bytes) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
