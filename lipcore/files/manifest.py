"""The schema of a model's manifest. Every entry is checked before it is used.

The manifest remains plain data: it is stored again as it was read.
"""

from dataclasses import dataclass
from typing import Annotated, Any, Required, TypedDict

import msgspec
from msgspec import UNSET, Meta, UnsetType

from lipcore.estimators.catalogue import Calibration
from lipcore.estimators.options import FitOptions
from lipcore.files import strict_json
from lipcore.files.entries import (
    MAX_VALUE,
    Entry,
    Estimate,
    JointKind,
    NonNegative,
    Number,
    Parameters,
    check_lengths,
    one_of,
)
from lipcore.files.strict_json import StrictJsonError, check_texts, quote
from lipcore.model.selection import Candidate, Count, HeldOut, Name, Selection, Sentence
from lipcore.posterior.conformal import Conformal
from lipcore.vocabulary import GEOMETRY_MODES, PRIORS, TORQUE_CONVENTIONS

FORMAT = "lipserve-model"
FORMAT_VERSION = 3
MANIFEST, TENSORS, ROBOT = "manifest.json", "model.safetensors", "robot.urdf"


class ModelFormatError(ValueError):
    """The files are not a valid model; the message names the mistake, and `file` the file."""

    def __init__(self, message: str, file: str = MANIFEST) -> None:
        super().__init__(message)
        self.file = file


@dataclass(frozen=True)
class Limits:
    """Max size of a model, which bounds the cost of loading it."""

    joints: int = 256
    """Max number of joints n."""
    inducing_samples: int = 5000
    """Max number of inducing samples S."""
    inducing_torques: int = 50_000
    """Max S n, the size of the largest square matrix computed."""
    inducing_outputs: int = 20_000
    """Max number of inducing torques m of the nonlinear term."""
    manifest_bytes: int = 4 * 1024 * 1024
    robot_bytes: int = 16 * 1024 * 1024


DEFAULT_LIMITS = Limits()
"""Limits for local stores, above everything that training can produce."""


class Fit(TypedDict, total=False):
    """Report of a fit: see `lipcore.estimators.hyperparameters.FitReport` and `lipcore.arm.learning`.

    Unknown names, as of other releases, may only have numbers and booleans; the same applies to `Compact`.
    """

    objective: float
    iterations: Count
    evaluations: Count
    rejected_steps: Count
    converged: bool
    start: Count
    samples_given: Count
    samples_hyperparameters: Count
    samples_posterior: Count
    samples_corrupt: Count
    samples_braked: Count
    corrupt: Annotated[
        str,
        Meta(max_length=300, pattern=r"^\d+ by [a-z]+(, \d+ by [a-z]+)*; the first are rows [\d, ]+, counted from 0$"),
    ]
    refit_error: Name
    independent_samples: NonNegative
    row_correlation: NonNegative
    motion_dimensions: NonNegative
    jitter: Annotated[float, Meta(ge=0, le=MAX_VALUE**2)]
    """(N·m)²"""
    seconds: NonNegative
    device: Annotated[str, Meta(pattern=r"^[a-z]{1,10}(:\d{1,3})?$")]
    fixed_joints: Sentence
    followed_joints: Sentence
    arms: Count
    geometry: Annotated[str, one_of(GEOMETRY_MODES)]
    friction_terms: Count
    stribeck_nats: float
    """Of versions of earlier releases, as `friction_terms`."""
    drive: Annotated[str, Meta(pattern=r"^[a-z, ]{0,60}$")]
    drive_nats: float
    mounting: Annotated[str, Meta(pattern=r"^[a-zA-Z, +-]{0,40}$")]
    search_objective: float
    search_starts: Count
    search_hops: Count
    search_optima: Count
    search_times_best: Count
    search_explained: bool
    search_ended: Annotated[str, Meta(pattern=r"^[a-z]{1,20}$")]
    search_seconds: NonNegative
    search_alternatives: Count
    search_next_nats: float


class Compact(TypedDict, total=False):
    """Accuracy of a compact posterior compared with the exact one: see `lipcore.posterior.compression`."""

    inducing_outputs: Count
    inducing_samples: Count
    weights: Count
    tolerance: NonNegative
    tolerance_reached: bool
    mean_rms: NonNegative
    mean_max: NonNegative
    std_max: NonNegative
    queries: Count
    data_samples: Required[Annotated[int, Meta(ge=0, le=int(MAX_VALUE))]]


class ValueRange(Entry):
    """Min and max of each joint."""

    min: list[Number]
    max: list[Number]

    def __post_init__(self) -> None:
        for joint, (low, high) in enumerate(zip(self.min, self.max, strict=False)):
            if low > high:
                raise ValueError(f"min[{joint}] is {low:g}, expected at most max[{joint}], which is {high:g}")


class TrainingRange(Entry):
    """See `lipcore.model.torque_model.training_range`."""

    q: ValueRange
    dq: ValueRange
    ddq: ValueRange


class File(Entry):
    """A file beside the manifest."""

    bytes: Count
    sha256: Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]


class TensorFile(File):
    """`model.safetensors`."""

    file: Annotated[str, one_of([TENSORS])]


class RobotFile(File):
    """`robot.urdf`. joints: of the URDF, for each joint of the data."""

    file: Annotated[str, one_of([ROBOT])]
    name: Annotated[str, Meta(max_length=200)]
    joints: list[str]
    matched: Annotated[str, one_of(("name", "order", "list"))]
    prior: Annotated[str, one_of(PRIORS)]


class Manifest(Entry, kw_only=True):
    """The entries of a manifest."""

    format: str
    format_version: int
    estimator: Name
    joint_names: list[Name]
    joint_types: list[JointKind]
    torque_convention: Annotated[str, one_of(TORQUE_CONVENTIONS)]
    noise_std: list[NonNegative]
    options: dict[str, Any]
    """Fields of `FitOptions`."""
    fit: Fit
    compact: Compact
    calibration: Calibration
    training_range: TrainingRange
    lineage: dict[str, Any]
    tensors: TensorFile
    parameters: Parameters
    warnings: Annotated[tuple[Annotated[str, Meta(min_length=1, max_length=4000)], ...], Meta(max_length=20)]
    hyperparameters: Annotated[dict[str, Any], Meta(max_length=1000)]
    robot: RobotFile | UnsetType = UNSET
    selection: Selection | UnsetType = UNSET
    conformal: Conformal | UnsetType = UNSET
    training_torque: Estimate | UnsetType = UNSET

    def __post_init__(self) -> None:
        """Raise ValueError if entries contradict each other."""
        n = len(self.joint_names)
        if not n or len(set(self.joint_names)) < n:
            raise ValueError(f"joint_names is {self.joint_names}, expected at least one name, and distinct names")
        check_lengths("", self, n)
        _check_known("options", self.options, FitOptions)
        try:
            FitOptions(**self.options)
        except ValueError as error:
            raise ValueError(f"options: {error}") from None
        if self.conformal is not UNSET:
            check_lengths("conformal.scale", list(self.conformal.scale), n)
        if self.selection is not UNSET:
            if self.selection["chosen"] != self.estimator:
                chosen = quote(self.selection["chosen"])
                raise ValueError(f"selection.chosen is {chosen}, expected the estimator, {quote(self.estimator)}")
            for place, row in enumerate(self.selection["table"]):
                for name in ("nmse", "edge_nmse", "coverage"):
                    check_lengths(f"selection.table[{place}].{name}", row.get(name), n)


_DECODER = msgspec.json.Decoder(Manifest)


def read_manifest_bytes(payload: bytes, limits: Limits = DEFAULT_LIMITS) -> dict[str, Any]:
    """Return the manifest in a file's bytes, with every entry checked.

    Raise ModelFormatError that names the entry, its value and the expected one.
    """
    try:
        manifest = strict_json.read(payload, limits.manifest_bytes)
    except StrictJsonError as error:
        raise ModelFormatError(f"{MANIFEST} cannot be read: {error}") from None
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ModelFormatError(f"{MANIFEST} is not a manifest of format {FORMAT!r}")
    if manifest.get("format_version") != FORMAT_VERSION:
        version = quote(manifest.get("format_version"))
        raise ModelFormatError(f"format_version is {version}, expected {FORMAT_VERSION}: train the model again")
    try:
        check_texts("", {name: entry for name, entry in manifest.items() if name not in ("lineage", "robot")})
        typed = strict_json.decode(_DECODER, payload, limits.manifest_bytes)
        _check_names(manifest)
    except StrictJsonError as error:
        raise ModelFormatError(str(error)) from None
    if len(typed.joint_names) > limits.joints:
        raise ModelFormatError(f"joint_names has {len(typed.joint_names)} entries, expected at most {limits.joints}")
    return manifest


def _check_known(where: str, entry: dict[str, Any], kind: type) -> None:
    for name in entry.keys() - kind.__annotations__.keys():
        raise StrictJsonError(f"{where} has the entry {quote(name)}, which this release does not know")


def _check_names(manifest: dict[str, Any]) -> None:
    """Raise StrictJsonError for unknown names in types that allow them."""
    kinds = {"calibration": Calibration, "conformal": Conformal, "selection": Selection}
    entries: list[tuple[str, Any, type]] = [(name, manifest[name], kinds[name]) for name in kinds if name in manifest]
    if "selection" in manifest:
        entries.append(("selection.held_out", manifest["selection"]["held_out"], HeldOut))
        rows = enumerate(manifest["selection"]["table"])
        entries += [(f"selection.table[{place}]", row, Candidate) for place, row in rows]
    for where, entry, kind in entries:
        _check_known(where, entry, kind)
    for where, known in (("fit", Fit), ("compact", Compact)):
        for name, value in manifest[where].items():
            if name not in known.__annotations__ and not isinstance(value, bool | int | float):
                raise StrictJsonError(f"{where}.{name} is {quote(value)}, expected a number or a boolean")
