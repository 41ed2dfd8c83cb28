"""Answering queries: no transport here."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lipcore.data.metrics import LEVELS, RELIABILITY_LEVELS
from lipcore.data.metrics import evaluate as compare
from lipcore.data.samples import Samples
from service.datasets import store
from service.foundation.errors import InvalidRequestError, invalid_request
from service.inference import checks, components
from service.inference.schema import EvaluateRequest, EvaluateResponse, Interval, PredictRequest, Reliability
from service.inference.stretches import stretches
from service.inference.wire import Prediction
from service.models import registry
from service.models.loaded import LoadedModels, Served
from service.storage.database import DatasetRow
from service.training import holding_out
from service.training.holding_out import CannotHoldOutError, SetSplit

Array = NDArray[np.float64]


def at_once(served: Served, motion: Array, max_position: float) -> Prediction | None:
    """Torque at one motion (3, n), for the event loop; None where the motion or the answer is not as it should be."""
    if motion.shape[1] != served.model.n_joints or abs(motion[0]).max() > max_position:
        return None
    mean, deviation = served.model.answer(motion)
    assert deviation is not None  # it is, unless declined
    tau, tau_std = mean.tolist(), deviation.tolist()
    if not isfinite(sum(tau) + sum(tau_std)):
        return None
    return _prediction(served, tau, tau_std)


def predict(loaded: LoadedModels, model: str, request: PredictRequest, served: Served | None = None) -> Prediction:
    """Torque with uncertainty at the queries; raise InvalidRequestError or NotFoundError. Not for the event loop.

    served: what answers, where that is found already.
    """
    settings = loaded.storage.settings
    served = served or loaded.get(model, request.version, request.alias)
    known = served.model
    single = request.q.ndim == 1
    components.check(known, request, settings.max_component_batch)
    for name in ("q", "dq", "ddq", "tau"):
        values = getattr(request, name)
        if values is None:
            continue
        if values.shape[-1] != known.n_joints:
            expected = f"{known.n_joints} numbers: {', '.join(known.joint_names)}"
            raise invalid_request(name, f"{values.shape[-1]} numbers long", expected)
        if values.shape != request.q.shape:
            raise invalid_request(name, f"of shape {values.shape}", f"the shape of q, {request.q.shape}")
    queries = np.atleast_2d(request.q)
    if len(queries) > settings.max_batch:
        raise invalid_request("q", f"{len(queries)} queries", f"at most {settings.max_batch} in one request")
    checks.positions(request.q, settings.max_position)

    answer = known.predict(queries, np.atleast_2d(request.dq), np.atleast_2d(request.ddq), request.covariance)
    parts = {"tau": answer.tau, "tau_std": answer.tau_std}
    if answer.covariance is not None:
        parts["covariance"] = answer.covariance
    found: dict[str, list[Any]] = {}
    for name, values in parts.items():
        shaped = values[0] if single else values
        checks.answer(name, shaped)
        found[name] = shaped.tolist()
    prediction = _prediction(served, **found)
    if request.components:
        prediction.components = components.answer(known, request)
    return prediction


def _prediction(served: Served, tau: list[Any], tau_std: list[Any], covariance: list[Any] | None = None) -> Prediction:
    model = served.model
    return Prediction(
        model=served.name,
        version=served.version,
        revision=served.revision,
        joint_names=model.joint_names,
        torque_convention=model.torque_convention,
        tau=tau,
        tau_std=tau_std,
        noise_std=served.noise_std,
        covariance=covariance,
    )


@dataclass(frozen=True)
class Measured:
    """A data set, or part of it, to compare models with. samples: how many it has; used: those that are compared,
    evenly thinned."""

    id: str
    sha256: str
    samples: int
    used: Samples

    def in_training_of(self, served: Served) -> bool:
        """Whether a version has learnt from it or from part of it, or from the same samples uploaded another time."""
        return served.has_learnt_from(self.id, self.sha256)


def measured(loaded: LoadedModels, dataset: str, *versions: Served) -> Measured:
    """Read a data set for these versions; raise NotFoundError, or InvalidRequestError where it is of other joints."""
    row = fitting(loaded, dataset, *versions)
    used = store.samples(loaded.files, row, loaded.storage.settings.max_evaluation_samples)
    return Measured(row.id, row.sha256, row.rows, used)


def held_out(loaded: LoadedModels, dataset: str, served: Served) -> Measured:
    """Read what the training of a version has held out of a data set; as `measured`, and where it was nothing raise
    InvalidRequestError."""
    row = fitting(loaded, dataset, served)
    split = split_of(loaded, row, served)
    try:
        used = store.samples(loaded.files, row, loaded.storage.settings.max_evaluation_samples, split.held_out)
    except CannotHoldOutError as error:
        raise not_held_out(str(error)) from None
    return Measured(row.id, row.sha256, split.rows, used)


def split_of(loaded: LoadedModels, row: DatasetRow, served: Served) -> SetSplit:
    """How a data set was split for a version; raise InvalidRequestError where nothing of it was held out."""
    version = registry.find(loaded.database, served.name, served.version)
    split = holding_out.remembered(row, version.manifest["lineage"])
    if split is None:
        raise not_held_out(f"version {served.version} has held nothing out of data set {row.id}")
    return split


def not_held_out(why: str) -> InvalidRequestError:
    """The error of a request for a part that there is not."""
    return invalid_request("part", "held_out", f"all, as {why}")


def fitting(loaded: LoadedModels, dataset: str, *versions: Served) -> DatasetRow:
    """The row of a data set; raise NotFoundError, or InvalidRequestError where its joints or its torque convention are
    not those of these versions."""
    row = store.find(loaded.database, dataset)
    for served in versions:
        known = served.model
        if tuple(row.joint_names) != known.joint_names:
            expected = f"the joints of the model, {list(known.joint_names)}"
            raise invalid_request("dataset", f"a data set with the joints {row.joint_names}", expected)
        if row.torque_convention != known.torque_convention:
            expected = f"that of the model, {known.torque_convention}"
            raise invalid_request("dataset", f"a data set whose torque is {row.torque_convention}", expected)
    return row


def evaluate(
    loaded: LoadedModels, model: str, request: EvaluateRequest, served: Served | None = None
) -> EvaluateResponse:
    """Compare a model with a data set or what it has held out of it; raise InvalidRequestError or NotFoundError.

    served: what answers, where that is found already.
    """
    served = served or loaded.get(model, request.version, request.alias)
    known = served.model
    whole = request.part == "all"
    recorded = (measured if whole else held_out)(loaded, request.dataset, served)
    used = recorded.used
    answer = known.predict(used.q, used.dq, used.ddq)
    metrics = compare(used.tau, answer.tau, answer.tau_std, answer.noise_std)
    return EvaluateResponse(
        model=served.name,
        version=served.version,
        revision=served.revision,
        dataset=recorded.id,
        part=request.part,
        joint_names=list(known.joint_names),
        samples=recorded.samples,
        samples_used=len(used),
        level=metrics.level,
        nmse=[None if np.isnan(value) else float(value) for value in metrics.nmse],
        rmse=metrics.rmse.tolist(),
        coverage=metrics.coverage.tolist(),
        nlpd=metrics.nlpd.tolist(),
        interval_width=metrics.width.tolist(),
        coverages=[
            Interval(level=each, coverage=coverage.tolist(), interval_width=width.tolist())
            for each, coverage, width in zip(LEVELS, metrics.coverages, metrics.widths, strict=True)
        ],
        reliability=Reliability(nominal=list(RELIABILITY_LEVELS), observed=metrics.reliability.T.tolist()),
        stretches=stretches(used, answer.tau),
        in_training=whole and recorded.in_training_of(served),
    )
