"""What a model's manifest may say: every entry is checked before anything is made of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

from lipcore.estimators.catalogue import Calibration
from lipcore.estimators.options import FitOptions
from lipcore.files import strict_json
from lipcore.files.arm import check_inertia, check_rotor, read_geometry
from lipcore.files.checks import (
    LARGEST,
    LARGEST_SQUARE,
    check_choice,
    check_keys,
    check_list,
    check_numbers,
    check_text,
    wrong,
)
from lipcore.files.strict_json import quote
from lipcore.kernels.friction import FRICTION_TERMS, STRIBECK
from lipcore.model.selection import MOST_TEXT, Candidate, HeldOut, Selection
from lipcore.posterior.conformal import Conformal
from lipcore.vocabulary import JOINT_TYPES, PRIORS, TORQUE_CONVENTIONS

FORMAT = "lipserve-model"
FORMAT_VERSION = 3
MANIFEST, TENSORS, ROBOT = "manifest.json", "model.safetensors", "robot.urdf"
MATCHINGS = ("name", "order", "list")
MOST_WARNINGS, MOST_SENTENCE = 20, 4000
MAX_CANDIDATES = 10


class ModelFormatError(ValueError):
    """Files do not hold a valid model; the message names what is wrong, `file` the file that it is in."""

    def __init__(self, message: str, file: str = MANIFEST) -> None:
        super().__init__(message)
        self.file = file


@dataclass(frozen=True)
class Limits:
    """How large a model may be: what it costs to load is bounded before it is loaded.

    joints: n; inducing_samples: S; inducing_torques: S n, whose square is the largest matrix computed;
    inducing_outputs: m; manifest_bytes, robot_bytes: of the files.
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
"""Raises ValueError unless the entry of this name, with this value, fits a model of n joints."""


def read_manifest_bytes(payload: bytes, limits: Limits = DEFAULT_LIMITS) -> dict[str, Any]:
    """The manifest that a file's bytes hold, every entry checked.

    Raise ModelFormatError that names the entry, its value and what was expected.
    """
    try:
        manifest = strict_json.read(payload, limits.manifest_bytes)
    except strict_json.StrictJsonError as error:
        raise ModelFormatError(f"{MANIFEST} cannot be read: {error}") from None
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ModelFormatError(f"{MANIFEST} is not a manifest of format {FORMAT!r}")
    if manifest.get("format_version") != FORMAT_VERSION or isinstance(manifest["format_version"], bool | float):
        version = quote(manifest.get("format_version"))
        raise ModelFormatError(f"format_version is {version}, expected {FORMAT_VERSION}: train the model again")
    try:
        _check(manifest, limits)
    except ValueError as error:
        raise ModelFormatError(str(error)) from None
    return manifest


def _check(manifest: dict[str, Any], limits: Limits) -> None:
    check_keys("manifest", manifest, {"format", "format_version", *REQUIRED}, OPTIONAL)
    names = manifest["joint_names"]
    _check_joint_names(names, limits)
    for name, check in {**REQUIRED, **OPTIONAL}.items():
        if name in manifest:
            check(name, manifest[name], len(names))
    if "selection" in manifest and manifest["selection"]["chosen"] != manifest["estimator"]:
        raise wrong("selection.chosen", manifest["selection"]["chosen"], f"the estimator, {manifest['estimator']!r}")


def _check_scalars(name: str, value: object, n: int) -> None:
    """An object of numbers, truth values and short texts."""
    if not isinstance(value, dict) or len(value) > 100:
        raise wrong(name, value, "an object of at most 100 entries")
    for key, each in value.items():
        check_text(f"a name of {name}", key)
        if isinstance(each, str):
            check_text(f"{name}.{key}", each)
        elif not isinstance(each, bool | int | float):
            raise wrong(f"{name}.{key}", each, "a number, a truth value or a text")


def _check_joint_names(names: object, limits: Limits) -> None:
    if not isinstance(names, list) or not 1 <= len(names) <= limits.joints:
        raise wrong("joint_names", names, f"a list of 1 to {limits.joints} names")
    for index, name in enumerate(names):
        check_text(f"joint_names[{index}]", name)
        if name in names[:index]:
            raise wrong(f"joint_names[{index}]", name, "names that differ")


def _check_joint_types(name: str, value: Any, n: int) -> None:
    for index, kind in enumerate(check_list(name, value, n)):
        check_choice(f"{name}[{index}]", kind, JOINT_TYPES)


def _check_options(name: str, value: Any, n: int) -> None:
    check_keys(name, value, (), {each.name for each in fields(FitOptions)})
    try:
        FitOptions(**value)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{name}: {error}") from None
    if not isinstance(value.get("tied", True), bool):
        raise wrong(f"{name}.tied", value["tied"], "true or false")


def _check_fit(name: str, value: Any, n: int) -> None:
    _check_scalars(name, value, n)
    check_numbers(f"{name}.jitter", value.get("jitter", 0.0), low=0, high=LARGEST_SQUARE)


def _check_compact(name: str, value: Any, n: int) -> None:
    _check_scalars(name, value, n)
    check_numbers(f"{name}.data_samples", value.get("data_samples"), low=0, high=LARGEST)


def _check_conformal(name: str, value: Any, n: int) -> None:
    check_keys(name, value, {each.name for each in fields(Conformal)})
    check_numbers(f"{name}.scale", value["scale"], (n,), 1, LARGEST)
    check_numbers(f"{name}.guaranteed", value["guaranteed"], (n,), 0, 1)
    if isinstance(value["blocks"], bool) or not isinstance(value["blocks"], int):
        raise wrong(f"{name}.blocks", value["blocks"], "a whole number")
    try:
        Conformal(**value)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def _check_calibration(name: str, value: Any, n: int) -> None:
    check_keys(name, value, {each.name for each in fields(Calibration)})
    for key, each in value.items():
        check_numbers(f"{name}.{key}", each)
    try:
        Calibration(**value)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def _check_range(name: str, value: Any, n: int) -> None:
    check_keys(name, value, ("q", "dq", "ddq"))
    for quantity, ends in value.items():
        where = f"{name}.{quantity}"
        check_keys(where, ends, ("min", "max"))
        for end in ("min", "max"):
            check_numbers(f"{where}.{end}", ends[end], (n,), -LARGEST, LARGEST)
        for joint, (low, high) in enumerate(zip(ends["min"], ends["max"], strict=True)):
            if low > high:
                raise wrong(f"{where}.min[{joint}]", low, f"at most the max, {high:g}")


def _check_training_torque(name: str, value: Any, n: int) -> None:
    check_keys(name, value, ("mean", "std"))
    check_numbers(f"{name}.mean", value["mean"], (n,), -LARGEST, LARGEST)
    check_numbers(f"{name}.std", value["std"], (n,), 0, LARGEST)


def _check_parameters(name: str, value: Any, n: int) -> None:
    arm = ("inertia", "rotor", "geometry") if isinstance(value, dict) and "inertia" in value else ()
    check_keys(name, value, ("friction", *arm))
    check_keys(f"{name}.friction", value["friction"], FRICTION_TERMS, (STRIBECK,))
    for term, figures in value["friction"].items():
        check_keys(f"{name}.friction.{term}", figures, ("mean", "std"))
        for key, numbers in figures.items():
            check_numbers(f"{name}.friction.{term}.{key}", numbers, (n,))
    try:
        if arm:
            check_inertia(value["inertia"], n)
            check_rotor(value["rotor"], n)
            for plausible in (False, True):
                read_geometry(value["geometry"], n, plausible)
    except ValueError as error:
        raise ValueError(f"{name}.{error}") from None


def _check_warnings(name: str, value: Any, n: int) -> None:
    if not isinstance(value, list) or len(value) > MOST_WARNINGS:
        raise wrong(name, value, f"a list of at most {MOST_WARNINGS} sentences")
    for index, each in enumerate(value):
        check_text(f"{name}[{index}]", each, MOST_SENTENCE)


def _check_hyperparameters(name: str, value: Any, n: int) -> None:
    if not isinstance(value, dict) or len(value) > 1000:
        raise wrong(name, value, "an object of at most 1000 entries")


def _check_lineage(name: str, value: Any, n: int) -> None:
    if not isinstance(value, dict):
        raise wrong(name, value, "an object")


def _check_selection(name: str, value: Any, n: int) -> None:
    check_keys(name, value, Selection.__annotations__)
    for key in ("asked", "chosen"):
        check_text(f"{name}.{key}", value[key])
    check_text(f"{name}.reason", value["reason"], MOST_TEXT)
    held = value["held_out"]
    check_keys(f"{name}.held_out", held, HeldOut.__required_keys__, HeldOut.__optional_keys__)
    for key in ("rows", "blocks", "edge_rows", "edge_blocks"):
        check_numbers(f"{name}.held_out.{key}", held.get(key, 0), low=0, high=LARGEST)
    if not isinstance(held["repeats"], bool):
        raise wrong(f"{name}.held_out.repeats", held["repeats"], "true or false")
    if not isinstance(value["table"], list) or not 1 <= len(value["table"]) <= MAX_CANDIDATES:
        raise wrong(f"{name}.table", value["table"], f"a list of 1 to {MAX_CANDIDATES}")
    for index, row in enumerate(value["table"]):
        _check_candidate(f"{name}.table[{index}]", row, n)


def _check_candidate(name: str, row: Any, n: int) -> None:
    check_keys(name, row, Candidate.__required_keys__, Candidate.__optional_keys__)
    check_text(f"{name}.estimator", row["estimator"])
    check_numbers(f"{name}.seconds", row["seconds"], low=0, high=LARGEST)
    if row["error"] is not None:
        check_text(f"{name}.error", row["error"], MOST_TEXT)
    for key in ("log_density", "difference", "standard_error"):
        if row[key] is not None:
            check_numbers(f"{name}.{key}", row[key])
    for key in ("nmse", "edge_nmse", "coverage"):
        values = row.get(key)
        for joint, each in enumerate(() if values is None else check_list(f"{name}.{key}", values, n)):
            if each is not None:
                check_numbers(f"{name}.{key}[{joint}]", each, low=0)


def _check_file(name: str, value: Mapping[str, Any], file: str) -> None:
    if value["file"] != file:
        raise wrong(f"{name}.file", value["file"], repr(file))
    if not isinstance(value["bytes"], int) or isinstance(value["bytes"], bool) or value["bytes"] < 0:
        raise wrong(f"{name}.bytes", value["bytes"], "a number of bytes")
    digest = value["sha256"]
    if not isinstance(digest, str) or len(digest) != 64 or set(digest) - set("0123456789abcdef"):
        raise wrong(f"{name}.sha256", digest, "64 hexadecimal digits")


def _check_tensors(name: str, value: Any, n: int) -> None:
    check_keys(name, value, ("file", "bytes", "sha256"))
    _check_file(name, value, TENSORS)


def _check_robot(name: str, value: Any, n: int) -> None:
    check_keys(name, value, ("name", "joints", "matched", "prior", "file", "bytes", "sha256"))
    _check_file(name, value, ROBOT)
    if not isinstance(value["name"], str) or len(value["name"]) > 200:
        raise wrong(f"{name}.name", value["name"], "at most 200 characters")
    for joint, each in enumerate(check_list(f"{name}.joints", value["joints"], n)):
        if not isinstance(each, str):  # it is looked up among the joints of the URDF
            raise wrong(f"{name}.joints[{joint}]", each, "the name of a joint")
    for key, known in (("matched", MATCHINGS), ("prior", PRIORS)):
        check_choice(f"{name}.{key}", value[key], known)


REQUIRED: dict[str, Check] = {
    "joint_names": lambda name, value, n: None,  # checked first: the others count by them
    "estimator": lambda name, value, n: check_text(name, value),
    "joint_types": _check_joint_types,
    "torque_convention": lambda name, value, n: check_choice(name, value, TORQUE_CONVENTIONS),
    "noise_std": lambda name, value, n: check_numbers(name, value, (n,), 0, LARGEST),
    "options": _check_options,
    "fit": _check_fit,
    "compact": _check_compact,
    "calibration": _check_calibration,
    "training_range": _check_range,
    "lineage": _check_lineage,
    "tensors": _check_tensors,
    "parameters": _check_parameters,
    "warnings": _check_warnings,
    "hyperparameters": _check_hyperparameters,
}
OPTIONAL: dict[str, Check] = {
    "robot": _check_robot,
    "selection": _check_selection,
    "conformal": _check_conformal,
    "training_torque": _check_training_torque,
}
