"""Evaluate a version on a data set or its held-out part, in figures or row by row."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from lipcore.data.metrics import TorqueDistribution
from lipcore.data.motion import spaced_rows
from lipcore.data.samples import Array, Samples
from lipcore.model import dynamics
from lipcore.model.verdict import JudgedOn
from lipcore.profiles import profile, recognise
from lipcore.vocabulary import offered_components
from service.contract import predictions as schema
from service.contract.holdout import Evaluation, HoldoutLineage
from service.contract.verdict import Verdict
from service.datasets import store
from service.foundation.errors import DamagedDataError, invalid_request
from service.inference import texts
from service.inference.predicting import MAX_COMPONENT_BATCH, check_offered
from service.models import registry, verdicts
from service.models.evaluation import MAX_EVALUATION_SAMPLES, evaluation
from service.models.served import ServedModel
from service.storage import sample_file
from service.storage.database import DatasetRow
from service.storage.storage import Storage
from service.training import holding_out, repeating
from service.training.holding_out import CannotHoldOutError, SetSplit

MAX_TRACE_POINTS = 2000
"""Maximum rows of one trace."""


@dataclass(frozen=True)
class EvaluationData:
    """A data set, or part of it, to evaluate versions on."""

    id: str
    sha256: str
    samples: int
    """Number of samples before thinning."""
    used: Samples
    """The evaluated samples, thinned evenly."""


def read_dataset(storage: Storage, dataset: str, *versions: ServedModel) -> EvaluationData:
    """Return the samples of a data set for these versions.

    Raise NotFoundError, or InvalidRequestError if the joints differ.
    """
    row = find_dataset(storage, dataset, *versions)
    used = store.samples(storage.files, row, MAX_EVALUATION_SAMPLES, joint_types=versions[0].model.joint_types)
    return EvaluationData(row.id, row.sha256, row.rows, used)


def read_held_out(storage: Storage, dataset: str, served: ServedModel) -> EvaluationData:
    """Return the samples of a data set that a version's training held out.

    Raise as `read_dataset` does, and InvalidRequestError if nothing was held out.
    """
    row = find_dataset(storage, dataset, served)
    with _splitting():
        split = _split_of(storage, row, served)
        used = store.samples(storage.files, row, MAX_EVALUATION_SAMPLES, split.held_out, served.model.joint_types)
    return EvaluationData(row.id, row.sha256, split.rows, used)


def _split_of(storage: Storage, row: DatasetRow, served: ServedModel) -> SetSplit:
    """Return how a version split a data set; raise CannotHoldOutError if nothing of it was held out."""
    split = holding_out.find_earlier_split(row, _manifest(storage, served)["lineage"])
    if split is None:
        raise CannotHoldOutError(f"version {served.version} has no held-out rows of data set {row.id}")
    return split


@contextmanager
def _splitting() -> Iterator[None]:
    """Raise InvalidRequestError for a CannotHoldOutError."""
    try:
        yield
    except CannotHoldOutError as error:
        raise invalid_request("part", "held_out", f"all: {error}") from None


def find_dataset(storage: Storage, dataset: str, *versions: ServedModel) -> DatasetRow:
    """Return the row of a data set.

    Raise NotFoundError, or InvalidRequestError if its joints or torque convention differ from those of these versions.
    """
    row = store.find(storage.database, dataset)
    for served in versions:
        known = served.model
        if tuple(row.joint_names) != known.joint_names:
            own, others = ", ".join(row.joint_names), ", ".join(known.joint_names)
            message = f"The joints of data set {row.id} are {own}; those of the model are {others}."
            message += _how_to_upload(row, known.joint_names)
            raise invalid_request("dataset", f"a data set with the joints {own}", f"the joints {others}", message)
        if row.torque_convention != known.torque_convention:
            own, others = row.torque_convention, known.torque_convention
            message = f"The torque of data set {row.id} is {own}; that of the model is {others}."
            raise invalid_request("dataset", f"a data set with torque {own}", f"torque {others}", message)
    return row


def _how_to_upload(row: DatasetRow, joint_names: Sequence[str]) -> str:
    """Return advice to upload the recording under these joint names; empty if the number of joints differs."""
    if len(row.joint_names) != len(joint_names):
        return ""
    named = next((name for name in recognise(joint_names) if profile(name).joint_names == tuple(joint_names)), None)
    option = f"joint_names={','.join(joint_names)}" if named is None else f"robot={named}"
    return f" If they are the same joints, upload the recording with {option}."


def evaluate(storage: Storage, served: ServedModel, request: schema.EvaluateRequest) -> schema.EvaluateResponse:
    """Evaluate a version on a data set or its held-out part; raise InvalidRequestError or NotFoundError.

    If the version has since learnt the held-out rows, return the figures of its judged fit.
    """
    row = find_dataset(storage, request.dataset, served)
    judged = _judged(storage, row, served) if request.part == "held_out" else None
    in_training, revision = False, 0
    if judged is None:
        in_training, revision = _in_training(storage, row, request.part, served), served.revision
    fields = _compared(storage, request, served, in_training) if judged is None else judged.model_dump()
    origin: JudgedOn = "training" if in_training else "held_out" if request.part == "held_out" else "recording"
    return schema.EvaluateResponse(
        model=served.name,
        version=served.version,
        revision=revision,
        dataset=row.id,
        part=request.part,
        joint_names=list(served.model.joint_names),
        in_training=in_training,
        judged=judged is not None,
        verdict=_verdict(storage, served, fields, origin, row),
        **fields,
    )


def judge(
    storage: Storage, recorded: EvaluationData, served: ServedModel, answer: TorqueDistribution, in_training: bool
) -> dict[str, Any]:
    """Return the fields of an `Evaluation` of a version's answer at the samples of a data set, and its `verdict`."""
    used = recorded.used
    figures = evaluation(used, answer, served.model.training_range)
    figures |= _repeats(storage, served, used, in_training)
    row = store.find(storage.database, recorded.id)
    return {**figures, "verdict": _verdict(storage, served, figures, "training" if in_training else "recording", row)}


def _verdict(
    storage: Storage, served: ServedModel, figures: dict[str, Any], origin: JudgedOn, row: DatasetRow
) -> Verdict:
    options = registry.verdict_options(storage.database, [served.name])[served.name]
    return verdicts.of_evaluation(figures, _manifest(storage, served), origin, row, options)


def _compared(
    storage: Storage, request: schema.EvaluateRequest, served: ServedModel, in_training: bool
) -> dict[str, Any]:
    """Return the fields of an `Evaluation` of a version."""
    recorded = (read_dataset if request.part == "all" else read_held_out)(storage, request.dataset, served)
    used = recorded.used
    answer = served.model.predict_along(used)
    repeats = _repeats(storage, served, used, in_training)
    figures = evaluation(used, answer.interval, served.model.training_range)
    return {"samples": recorded.samples, **figures, **repeats}


def _judged(storage: Storage, row: DatasetRow, served: ServedModel) -> Evaluation | None:
    """Return the judged fit's evaluation of a data set's held-out part; None unless the lineage contains it."""
    if not (record := _holdout_of(storage, served)).get("learnt"):
        return None
    holdout = HoldoutLineage.model_validate(record)
    names = [each.id for each in holdout.datasets if row.id == each.id or row.sha256 == each.sha256]
    return next((holdout.evaluations[name] for name in names if name in holdout.evaluations), None)


def _in_training(storage: Storage, row: DatasetRow, part: schema.Part, served: ServedModel) -> bool:
    """Return whether a version has learnt a data set, part of it, or its held-out part."""
    if part == "held_out" and not _holdout_of(storage, served).get("learnt"):
        return False
    return served.has_learnt_from(row.id, row.sha256)


def _holdout_of(storage: Storage, served: ServedModel) -> dict[str, Any]:
    """Return the held-out record of a version's lineage; empty if nothing was held out."""
    return _manifest(storage, served)["lineage"].get("holdout") or {}


def _manifest(storage: Storage, served: ServedModel) -> dict[str, Any]:
    return registry.find(storage.database, served.name, served.version).manifest


def _repeats(storage: Storage, served: ServedModel, used: Samples, in_training: bool) -> dict[str, Any]:
    """Return how much of the samples repeats the training motion, unless the version was trained on them."""
    if in_training:
        return repeating.find_repetition([], used, served.model.joint_types)
    try:
        training = repeating.read_training_parts(storage.database, storage.files, _manifest(storage, served)["lineage"])
        return repeating.find_repetition(training, used, served.model.joint_types)
    except (CannotHoldOutError, DamagedDataError) as error:  # the figures are valid without the training data
        return {**repeating.find_repetition([], used, ()), "warnings": [texts.describe_unknown_repetition(error)]}


Rows = NDArray[np.int64]


def trace(storage: Storage, served: ServedModel, request: schema.TraceRequest) -> schema.TraceResponse:
    """Predict along a data set or its held-out part; raise InvalidRequestError, NotFoundError or DamagedDataError."""
    if request.points > MAX_TRACE_POINTS:
        raise invalid_request("points", request.points, f"at most {MAX_TRACE_POINTS}")
    offered = offered_components(served.model.estimator.name)
    check_offered(served.model, request.components)
    dataset = find_dataset(storage, request.dataset, served)
    path = storage.files.samples_file(dataset.id, dataset.sha256)
    episode, t = (sample_file.read_array(path, name) for name in ("episode", "t"))
    part = np.arange(len(t), dtype=np.int64)
    if request.part == "held_out":
        with _splitting():
            part = np.flatnonzero(_split_of(storage, dataset, served).held_out(episode, t)).astype(np.int64)
    chosen = _within(part, request, len(t))
    rows = chosen[spaced_rows(len(chosen), request.points)]
    samples = Samples(served.model.joint_names, **sample_file.read(path, rows))
    deflections = sample_file.follow(sample_file.Reader(path), rows, served.model.joint_types)
    samples = replace(samples, deflections=deflections)
    predicted = served.model.predict_along(samples)
    return schema.TraceResponse(
        model=served.name,
        version=served.version,
        revision=served.revision,
        dataset=dataset.id,
        part=request.part,
        joint_names=list(served.model.joint_names),
        torque_convention=served.model.torque_convention,
        samples=len(part),
        in_range=len(chosen),
        shown=len(rows),
        rows=rows.tolist(),
        t=samples.t.tolist(),
        breaks=_breaks(part, episode, rows),
        tau=samples.tau.tolist(),
        mean=predicted.tau.tolist(),
        std=predicted.tau_std.tolist(),
        noise_std=predicted.noise_std.tolist(),
        scale=predicted.scale.tolist(),
        offered=[name for name in get_args(schema.TraceComponent) if name in offered],
        components=_components(served, samples, request.components, MAX_COMPONENT_BATCH),
        in_training=_in_training(storage, dataset, request.part, served),
    )


def _within(part: Rows, request: schema.TraceRequest, count: int) -> Rows:
    """Return the rows of a part from `start` to `stop`; raise InvalidRequestError if there are none."""
    if request.start >= count:
        raise invalid_request("start", request.start, f"a row of the data set, 0 to {count - 1}")
    if request.stop is not None and request.stop <= request.start:
        raise invalid_request("stop", request.stop, f"a row after start, {request.start}")
    stop = count if request.stop is None else request.stop
    chosen = part[(part >= request.start) & (part < stop)]
    if not len(chosen):
        message = f"Rows {request.start} to {stop} contain no held-out rows; these lie in {part[0]} to {part[-1]}."
        raise invalid_request("start", f"{request.start}, up to {stop}", "a range with held-out rows", message)
    return chosen


def _breaks(part: Rows, episode: NDArray[np.int64], rows: Rows) -> list[int]:
    """Return the positions in `rows` before which the part is interrupted or the episode changes."""
    anew = (np.diff(part) != 1) | (np.diff(episode[part]) != 0)
    piece = np.concatenate([[0], np.cumsum(anew)])[np.searchsorted(part, rows)]
    return (np.flatnonzero(np.diff(piece)) + 1).tolist()


def _components(
    served: ServedModel, samples: Samples, names: Sequence[schema.TraceComponent], batch: int
) -> dict[schema.TraceComponent, schema.TraceComponentValues]:
    """Return torque components at samples, computed in batches: they need far more memory than a torque."""
    if not names:
        return {}
    mean: dict[schema.TraceComponent, list[Array]] = {name: [] for name in names}
    std: dict[schema.TraceComponent, list[Array]] = {name: [] for name in names}
    for first in range(0, len(samples), batch):
        some = samples.rows(slice(first, first + batch))
        estimates = dynamics.components(served.model, some.motion(), names)
        for name in names:
            mean[name].append(estimates[name].mean)
            std[name].append(estimates[name].std)
    return {
        name: schema.TraceComponentValues(
            mean=np.concatenate(mean[name]).tolist(), std=np.concatenate(std[name]).tolist()
        )
        for name in names
    }
