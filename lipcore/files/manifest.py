"""What a model's manifest may say: every entry is checked before anything is made of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, fields
from typing import Any

from lipcore.files import strict_json
from lipcore.files.arm import check_inertia, check_rotor, read_geometry
from lipcore.files.strict_json import quote
from lipcore.fitting.estimators import Calibration
from lipcore.fitting.options import FitOptions
from lipcore.kernels.friction import FRICTION_TERMS, STRIBECK
from lipcore.model.selection import MOST_TEXT, Candidate, HeldOut, Selection
from lipcore.vocabulary import JOINT_TYPES, PRIORS, TORQUE_CONVENTIONS

FORMAT = "lipserve-model"
FORMAT_VERSION = 3
MANIFEST, TENSORS, ROBOT = "manifest.json", "model.safetensors", "robot.urdf"
MATCHINGS = ("name", "order", "list")
MAX_NAME = 100
MOST_WARNINGS, MOST_SENTENCE = 20, 4000
MAX_CANDIDATES = 10
LARGEST = 1e12
"""No motion or torque in SI units is larger."""


class ModelFormatError(ValueError):
    """Files do not hold a valid model; the message names what is wrong, `file` the file that it is in."""

    def __init__(self, message: str, file: str = MANIFEST) -> None:
        super().__init__(message)
        self.file = file


@dataclass(frozen=True)
class Limits:
    """How large a model may be: what it costs to load is bounded before it is loaded.

    inducing_samples: S; inducing_torques: S n, whose square is the largest matrix computed; inducing_outputs: m.
    """

    joints: int = 256
    inducing_samples: int = 5000
    inducing_torques: int = 50_000
    inducing_outputs: int = 20_000
    manifest_bytes: int = 4 * 1024 * 1024
    robot_bytes: int = 16 * 1024 * 1024


DEFAULT_LIMITS = Limits()
"""Beyond what training can make; for stores of one's own."""

Check = Callable[[str, Any, int], None]
"""Raises ModelFormatError unless the entry of this name, with this value, fits a model of n joints."""


def read_manifest_bytes(payload: bytes, limits: Limits = DEFAULT_LIMITS) -> dict[str, Any]:
    """Read and check a manifest; raise ModelFormatError."""
    try:
        manifest = strict_json.read(payload, limits.manifest_bytes)
    except strict_json.StrictJsonError as error:
        raise ModelFormatError(f"{MANIFEST} cannot be read: {error}") from None
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ModelFormatError(f"{MANIFEST} is not a manifest of format {FORMAT!r}")
    if manifest.get("format_version") != FORMAT_VERSION or isinstance(manifest["format_version"], bool | float):
        found = quote(manifest.get("format_version"))
        raise ModelFormatError(f"format_version is {found}, expected {FORMAT_VERSION}: train the model again")
    _check_keys("manifest", manifest, {"format", "format_version", *REQUIRED}, OPTIONAL)
    names = manifest["joint_names"]
    _check_joint_names(names, limits)
    for name, check in {**REQUIRED, **OPTIONAL}.items():
        if name in manifest:
            check(name, manifest[name], len(names))
    if "selection" in manifest and manifest["selection"]["chosen"] != manifest["estimator"]:
        raise _fail("selection.chosen", manifest["selection"]["chosen"], f"the estimator, {manifest['estimator']!r}")
    return manifest


def _fail(name: str, value: object, expected: str) -> ModelFormatError:
    return ModelFormatError(f"{name} is {quote(value)}, expected {expected}")


def _check_keys(name: str, value: object, required: Collection[str], optional: Collection[str] = ()) -> None:
    if not isinstance(value, dict):
        raise _fail(name, value, "an object")
    for key in required:
        if key not in value:
            raise ModelFormatError(f"{name} lacks {key}")
    for key in value:
        if key not in required and key not in optional:
            raise ModelFormatError(f"{name} has the entry {quote(key)}, which this release does not know")


def _check_text(name: str, value: object, most: int = MAX_NAME) -> None:
    if not isinstance(value, str) or not 1 <= len(value) <= most or not value.isprintable():
        raise _fail(name, value, f"1 to {most} printable characters")


def _check_number(name: str, value: object, low: float = -math.inf, high: float = math.inf) -> None:
    if not isinstance(value, int | float) or isinstance(value, bool) or not low <= value <= high:
        bounds = "" if (low, high) == (-math.inf, math.inf) else f" from {low:g} to {high:g}"
        raise _fail(name, value, f"a number{bounds}")


def _check_list(name: str, value: object, n: int) -> list[Any]:
    if not isinstance(value, list) or len(value) != n:
        raise _fail(name, value, f"a list of {n}")
    return value


def _check_scalars(name: str, value: object, n: int) -> None:
    """An object of numbers, truth values and short texts."""
    if not isinstance(value, dict) or len(value) > 100:
        raise _fail(name, value, "an object of at most 100 entries")
    for key, each in value.items():
        _check_text(f"a name of {name}", key)
        if isinstance(each, str):
            _check_text(f"{name}.{key}", each)
        elif not isinstance(each, bool | int | float):
            raise _fail(f"{name}.{key}", each, "a number, a truth value or a text")


def _check_joint_names(names: object, limits: Limits) -> None:
    if not isinstance(names, list) or not 1 <= len(names) <= limits.joints:
        raise _fail("joint_names", names, f"a list of 1 to {limits.joints} names")
    for index, name in enumerate(names):
        _check_text(f"joint_names[{index}]", name)
        if name in names[:index]:
            raise _fail(f"joint_names[{index}]", name, "names that differ")


def _check_joint_types(name: str, value: Any, n: int) -> None:
    for index, kind in enumerate(_check_list(name, value, n)):
        if kind not in JOINT_TYPES:
            raise _fail(f"{name}[{index}]", kind, f"one of {', '.join(JOINT_TYPES)}")


def _check_convention(name: str, value: Any, n: int) -> None:
    if value not in TORQUE_CONVENTIONS:
        raise _fail(name, value, f"one of {', '.join(TORQUE_CONVENTIONS)}")


def _check_noise(name: str, value: Any, n: int) -> None:
    for joint, each in enumerate(_check_list(name, value, n)):
        _check_number(f"{name}[{joint}]", each, 0, LARGEST)


def _check_options(name: str, value: Any, n: int) -> None:
    _check_keys(name, value, (), {each.name for each in fields(FitOptions)})
    try:
        FitOptions(**value)
    except (ValueError, TypeError) as error:
        raise ModelFormatError(f"{name}: {error}") from None
    if not isinstance(value.get("tied", True), bool):
        raise _fail(f"{name}.tied", value["tied"], "true or false")


def _check_fit(name: str, value: Any, n: int) -> None:
    _check_scalars(name, value, n)
    _check_number(f"{name}.jitter", value.get("jitter", 0.0), 0, LARGEST)


def _check_compact(name: str, value: Any, n: int) -> None:
    _check_scalars(name, value, n)
    _check_number(f"{name}.data_samples", value.get("data_samples"), 0, LARGEST)


def _check_calibration(name: str, value: Any, n: int) -> None:
    _check_keys(name, value, {each.name for each in fields(Calibration)})
    for key, each in value.items():
        _check_number(f"{name}.{key}", each)
    try:
        Calibration(**value)
    except ValueError as error:
        raise ModelFormatError(f"{name}: {error}") from None


def _check_range(name: str, value: Any, n: int) -> None:
    _check_keys(name, value, ("q", "dq", "ddq"))
    for quantity, ends in value.items():
        where = f"{name}.{quantity}"
        _check_keys(where, ends, ("min", "max"))
        for end in ("min", "max"):
            for joint, each in enumerate(_check_list(f"{where}.{end}", ends[end], n)):
                _check_number(f"{where}.{end}[{joint}]", each, -LARGEST, LARGEST)
        for joint, (low, high) in enumerate(zip(ends["min"], ends["max"], strict=True)):
            if low > high:
                raise _fail(f"{where}.min[{joint}]", low, f"at most the max, {high:g}")


def _check_parameters(name: str, value: Any, n: int) -> None:
    _check_keys(name, value, ("friction",), ("inertia", "rotor", "geometry"))
    _check_keys(f"{name}.friction", value["friction"], FRICTION_TERMS, (STRIBECK,))
    for term, figures in value["friction"].items():
        _check_keys(f"{name}.friction.{term}", figures, ("mean", "std"))
        for key, numbers in figures.items():
            for joint, each in enumerate(_check_list(f"{name}.friction.{term}.{key}", numbers, n)):
                _check_number(f"{name}.friction.{term}.{key}[{joint}]", each)
    try:
        if "inertia" in value:
            check_inertia(value["inertia"], n)
        if "rotor" in value:
            check_rotor(value["rotor"], n)
        if "geometry" in value:
            for plausible in (False, True):
                read_geometry(value["geometry"], n, plausible)
    except ValueError as error:
        raise ModelFormatError(f"{name}.{error}") from None


def _check_warnings(name: str, value: Any, n: int) -> None:
    if not isinstance(value, list) or len(value) > MOST_WARNINGS:
        raise _fail(name, value, f"a list of at most {MOST_WARNINGS} sentences")
    for index, each in enumerate(value):
        _check_text(f"{name}[{index}]", each, MOST_SENTENCE)


def _check_hyperparameters(name: str, value: Any, n: int) -> None:
    if not isinstance(value, dict) or len(value) > 1000:
        raise _fail(name, value, "an object of at most 1000 entries")


def _check_lineage(name: str, value: Any, n: int) -> None:
    if not isinstance(value, dict):
        raise _fail(name, value, "an object")


def _check_selection(name: str, value: Any, n: int) -> None:
    _check_keys(name, value, Selection.__annotations__)
    for key in ("asked", "chosen"):
        _check_text(f"{name}.{key}", value[key])
    _check_text(f"{name}.reason", value["reason"], MOST_TEXT)
    held = value["held_out"]
    _check_keys(f"{name}.held_out", held, HeldOut.__annotations__)
    for key in ("rows", "blocks"):
        _check_number(f"{name}.held_out.{key}", held[key], 0, LARGEST)
    if not isinstance(held["repeats"], bool):
        raise _fail(f"{name}.held_out.repeats", held["repeats"], "true or false")
    if not isinstance(value["table"], list) or not 1 <= len(value["table"]) <= MAX_CANDIDATES:
        raise _fail(f"{name}.table", value["table"], f"a list of 1 to {MAX_CANDIDATES}")
    for index, row in enumerate(value["table"]):
        _check_candidate(f"{name}.table[{index}]", row, n)


def _check_candidate(name: str, row: Any, n: int) -> None:
    _check_keys(name, row, Candidate.__annotations__)
    _check_text(f"{name}.estimator", row["estimator"])
    _check_number(f"{name}.seconds", row["seconds"], 0, LARGEST)
    if row["error"] is not None:
        _check_text(f"{name}.error", row["error"], MOST_TEXT)
    for key in ("log_density", "difference", "standard_error"):
        if row[key] is not None:
            _check_number(f"{name}.{key}", row[key])
    for key in ("nmse", "coverage"):
        for joint, each in enumerate(() if row[key] is None else _check_list(f"{name}.{key}", row[key], n)):
            if each is not None:
                _check_number(f"{name}.{key}[{joint}]", each, 0)


def _check_file(name: str, value: Mapping[str, Any], file: str) -> None:
    if value["file"] != file:
        raise _fail(f"{name}.file", value["file"], repr(file))
    if not isinstance(value["bytes"], int) or isinstance(value["bytes"], bool) or value["bytes"] < 0:
        raise _fail(f"{name}.bytes", value["bytes"], "a number of bytes")
    digest = value["sha256"]
    if not isinstance(digest, str) or len(digest) != 64 or set(digest) - set("0123456789abcdef"):
        raise _fail(f"{name}.sha256", digest, "64 hexadecimal digits")


def _check_tensors(name: str, value: Any, n: int) -> None:
    _check_keys(name, value, ("file", "bytes", "sha256"))
    _check_file(name, value, TENSORS)


def _check_robot(name: str, value: Any, n: int) -> None:
    _check_keys(name, value, ("name", "joints", "matched", "prior", "file", "bytes", "sha256"))
    _check_file(name, value, ROBOT)
    if not isinstance(value["name"], str) or len(value["name"]) > 200:
        raise _fail(f"{name}.name", value["name"], "at most 200 characters")
    for joint, each in enumerate(_check_list(f"{name}.joints", value["joints"], n)):
        if not isinstance(each, str):  # it is looked up among the joints of the URDF
            raise _fail(f"{name}.joints[{joint}]", each, "the name of a joint")
    for key, known in (("matched", MATCHINGS), ("prior", PRIORS)):
        if value[key] not in known:
            raise _fail(f"{name}.{key}", value[key], f"one of {', '.join(known)}")


REQUIRED: dict[str, Check] = {
    "joint_names": lambda name, value, n: None,  # checked first: the others count by them
    "estimator": lambda name, value, n: _check_text(name, value),
    "joint_types": _check_joint_types,
    "torque_convention": _check_convention,
    "noise_std": _check_noise,
    "options": _check_options,
    "fit": _check_fit,
    "compact": _check_compact,
    "calibration": _check_calibration,
    "training_range": _check_range,
    "lineage": _check_lineage,
    "tensors": _check_tensors,
}
OPTIONAL: dict[str, Check] = {
    "parameters": _check_parameters,
    "warnings": _check_warnings,
    "hyperparameters": _check_hyperparameters,
    "robot": _check_robot,
    "selection": _check_selection,
}
