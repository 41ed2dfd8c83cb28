"""Comparing a version with a data set, or with what its training held out of it, in figures or row by row."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from lipcore.data.motion import Motion
from lipcore.data.samples import Array, Samples
from lipcore.model import dynamics
from lipcore.profiles import profile, recognise
from service.contract import predictions as schema
from service.contract.models import Evaluation, HoldoutLineage
from service.datasets import store
from service.foundation.errors import DamagedDataError, invalid_request
from service.inference.predicting import MAX_COMPONENT_BATCH, check_offered
from service.models import registry
from service.models.evaluation import MAX_EVALUATION_SAMPLES, evaluation
from service.models.loaded import LoadedModels, Served
from service.storage import sample_file
from service.storage.database import DatasetRow
from service.training import holding_out, repeating
from service.training.holding_out import CannotHoldOutError, SetSplit

MAX_TRACE_POINTS = 2000
"""Rows of one trace of a model along a data set."""


@dataclass(frozen=True)
class Measured:
    """A data set, or part of it, to compare models with. samples: how many it has; used: those that are compared,
    evenly thinned."""

    id: str
    sha256: str
    samples: int
    used: Samples


def measured(loaded: LoadedModels, dataset: str, *versions: Served) -> Measured:
    """Read a data set for these versions; raise NotFoundError, or InvalidRequestError where it is of other joints."""
    row = fitting(loaded, dataset, *versions)
    used = store.samples(loaded.files, row, MAX_EVALUATION_SAMPLES)
    return Measured(row.id, row.sha256, row.rows, used)


def held_out(loaded: LoadedModels, dataset: str, served: Served) -> Measured:
    """Read what the training of a version has held out of a data set; as `measured`, and where it was nothing raise
    InvalidRequestError."""
    row = fitting(loaded, dataset, served)
    with _splitting():
        split = _split_of(loaded, row, served)
        used = store.samples(loaded.files, row, MAX_EVALUATION_SAMPLES, split.held_out)
    return Measured(row.id, row.sha256, split.rows, used)


def _split_of(loaded: LoadedModels, row: DatasetRow, served: Served) -> SetSplit:
    """How a data set was split for a version; raise CannotHoldOutError where nothing of it was held out."""
    version = registry.find(loaded.database, served.name, served.version)
    split = holding_out.remembered(row, version.manifest["lineage"])
    if split is None:
        raise CannotHoldOutError(f"version {served.version} has held nothing out of data set {row.id}")
    return split


@contextmanager
def _splitting() -> Iterator[None]:
    """Raise InvalidRequestError where there is no part that was held out."""
    try:
        yield
    except CannotHoldOutError as error:
        raise invalid_request("part", "held_out", f"all, as {error}") from None


def fitting(loaded: LoadedModels, dataset: str, *versions: Served) -> DatasetRow:
    """The row of a data set; raise NotFoundError, or InvalidRequestError where its joints or its torque convention are
    not those of these versions."""
    row = store.find(loaded.database, dataset)
    for served in versions:
        known = served.model
        if tuple(row.joint_names) != known.joint_names:
            expected = f"those of the model, {', '.join(known.joint_names)}{_how_to_upload(row, known.joint_names)}"
            raise invalid_request("dataset", f"a data set with the joints {', '.join(row.joint_names)}", expected)
        if row.torque_convention != known.torque_convention:
            expected = f"that of the model, {known.torque_convention}"
            raise invalid_request("dataset", f"a data set whose torque is {row.torque_convention}", expected)
    return row


def _how_to_upload(row: DatasetRow, joint_names: Sequence[str]) -> str:
    """What makes a data set one of these joints, where it has as many."""
    if len(row.joint_names) != len(joint_names):
        return ""
    named = next((name for name in recognise(joint_names) if profile(name).joint_names == tuple(joint_names)), None)
    option = f"joint_names={','.join(joint_names)}" if named is None else f"robot={named}"
    return f"; if they are the same joints, upload the recording with {option}"


def evaluate(
    loaded: LoadedModels, model: str, request: schema.EvaluateRequest, served: Served | None = None
) -> schema.EvaluateResponse:
    """Compare a model with a data set or what it has held out of it; raise InvalidRequestError or NotFoundError.

    Of rows held out that a version has learnt since, the figures of its judged fit are returned. served: what answers,
    where that is found already.
    """
    served = served or loaded.get(model, request.version, request.alias)
    row = fitting(loaded, request.dataset, served)
    judged = _judged(loaded, row, served) if request.part == "held_out" else None
    in_training, revision = False, 0
    if judged is None:
        in_training, revision = _in_training(loaded, row, request.part, served), served.revision
    return schema.EvaluateResponse(
        model=served.name,
        version=served.version,
        revision=revision,
        dataset=row.id,
        part=request.part,
        joint_names=list(served.model.joint_names),
        in_training=in_training,
        judged=judged is not None,
        **(_compared(loaded, request, served, in_training) if judged is None else judged.model_dump()),
    )


def _compared(
    loaded: LoadedModels, request: schema.EvaluateRequest, served: Served, in_training: bool
) -> dict[str, Any]:
    """Fields of an `Evaluation` of a version."""
    recorded = (measured if request.part == "all" else held_out)(loaded, request.dataset, served)
    used = recorded.used
    answer = served.model.predict(used.q, used.dq, used.ddq)
    repeats = _repeats(loaded, served, used, in_training)
    return {"samples": recorded.samples, **evaluation(used, answer.interval), **repeats}


def _judged(loaded: LoadedModels, row: DatasetRow, served: Served) -> Evaluation | None:
    """How the judged fit of a version predicts what was held out of a data set; None unless its lineage says so."""
    if not (record := _holdout_of(loaded, served)).get("learnt"):
        return None
    holdout = HoldoutLineage.model_validate(record)
    names = [each.id for each in holdout.datasets if row.id == each.id or row.sha256 == each.sha256]
    return next((holdout.evaluations[name] for name in names if name in holdout.evaluations), None)


def _in_training(loaded: LoadedModels, row: DatasetRow, part: schema.Part, served: Served) -> bool:
    """Whether a version has learnt a data set or part of it, or what was held out of it."""
    if part == "held_out" and not _holdout_of(loaded, served).get("learnt"):
        return False
    return served.has_learnt_from(row.id, row.sha256)


def _holdout_of(loaded: LoadedModels, served: Served) -> dict[str, Any]:
    """What the lineage of a version says of what was held out; empty if that is nothing."""
    version = registry.find(loaded.database, served.name, served.version)
    return version.manifest["lineage"].get("holdout") or {}


def _repeats(loaded: LoadedModels, served: Served, used: Samples, in_training: bool) -> dict[str, Any]:
    """How much of the samples repeats what a version was trained on, where it was not trained on these."""
    if in_training:
        return repeating.look([], used, served.model.joint_types)
    version = registry.find(loaded.database, served.name, served.version)
    try:
        training = repeating.trained_on(loaded.database, loaded.files, version.manifest["lineage"])
        return repeating.look(training, used, served.model.joint_types)
    except (CannotHoldOutError, DamagedDataError) as error:  # the samples judged can be read, and figures be had
        return {**repeating.look([], used, ()), "warnings": [f"whether they repeat the training is not known: {error}"]}


Rows = NDArray[np.int64]


def trace(loaded: LoadedModels, model: str, request: schema.TraceRequest) -> schema.TraceResponse:
    """Follow a model along a data set or what it has held out of it. Raise InvalidRequestError, NotFoundError or
    DamagedDataError. Not for the event loop."""
    if request.points > MAX_TRACE_POINTS:
        raise invalid_request("points", request.points, f"at most {MAX_TRACE_POINTS}")
    served = loaded.get(model, request.version, request.alias)
    offered = dynamics.available(served.model.estimator)
    check_offered(served.model, request.components)
    dataset = fitting(loaded, request.dataset, served)
    path = loaded.files.samples_file(dataset.id, dataset.sha256)
    episode, t = (sample_file.read_array(path, name) for name in ("episode", "t"))
    part = np.arange(len(t), dtype=np.int64)
    if request.part == "held_out":
        with _splitting():
            part = np.flatnonzero(_split_of(loaded, dataset, served).held_out(episode, t)).astype(np.int64)
    chosen = _within(part, request, len(t))
    rows = chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), request.points)).round().astype(np.int64)]
    samples = Samples(served.model.joint_names, **sample_file.read(path, rows))
    predicted = served.model.predict(samples.q, samples.dq, samples.ddq)
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
        in_training=_in_training(loaded, dataset, request.part, served),
    )


def _within(part: Rows, request: schema.TraceRequest, count: int) -> Rows:
    """Rows of a part from `start` to `stop`; raise InvalidRequestError where there are none."""
    if request.start >= count:
        raise invalid_request("start", request.start, f"a row of the data set, 0 to {count - 1}")
    if request.stop is not None and request.stop <= request.start:
        raise invalid_request("stop", request.stop, f"a row after start, {request.start}")
    stop = count if request.stop is None else request.stop
    chosen = part[(part >= request.start) & (part < stop)]
    if not len(chosen):
        expected = f"rows of which some were held out; these lie between {part[0]} and {part[-1]}"
        raise invalid_request("start", f"{request.start}, up to {stop}", expected)
    return chosen


def _breaks(part: Rows, episode: NDArray[np.int64], rows: Rows) -> list[int]:
    """Places in `rows` before which the part is interrupted or the episode changes."""
    anew = (np.diff(part) != 1) | (np.diff(episode[part]) != 0)
    piece = np.concatenate([[0], np.cumsum(anew)])[np.searchsorted(part, rows)]
    return (np.flatnonzero(np.diff(piece)) + 1).tolist()


def _components(
    served: Served, samples: Samples, names: Sequence[schema.TraceComponent], batch: int
) -> dict[schema.TraceComponent, schema.TraceComponentValues]:
    """Parts of the torque at samples, so many at a time: they take far more memory than a torque."""
    if not names:
        return {}
    mean: dict[schema.TraceComponent, list[Array]] = {name: [] for name in names}
    std: dict[schema.TraceComponent, list[Array]] = {name: [] for name in names}
    for first in range(0, len(samples), batch):
        some = samples.rows(slice(first, first + batch))
        estimates = dynamics.components(served.model, Motion.from_arrays(some.q, some.dq, some.ddq), names)
        for name in names:
            mean[name].append(estimates[name].mean)
            std[name].append(estimates[name].std)
    return {
        name: schema.TraceComponentValues(
            mean=np.concatenate(mean[name]).tolist(), std=np.concatenate(std[name]).tolist()
        )
        for name in names
    }
