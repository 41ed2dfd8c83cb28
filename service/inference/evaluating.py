"""Comparing a version with a data set, or with what its training held out of it: no transport here."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lipcore.data.metrics import LEVELS, RELIABILITY_LEVELS
from lipcore.data.metrics import evaluate as compare
from lipcore.data.samples import Array, Samples
from service.datasets import store
from service.foundation.errors import InvalidRequestError, invalid_request
from service.inference.schema import EvaluateRequest, EvaluateResponse, Interval, Reliability, Stretches
from service.models import registry
from service.models.loaded import LoadedModels, Served
from service.storage.database import DatasetRow
from service.training import holding_out
from service.training.holding_out import CannotHoldOutError, SetSplit

FEWEST_EPISODES, MOST_EPISODES = 5, 200
"""Episodes stand for stretches where there are so many; fewer make no box plot, more are mostly a few samples long."""
EQUAL = 10


def stretches(samples: Samples, mean: Array) -> Stretches:
    """Mean squared error of each stretch / variance of the measured torque over all samples; mean: (N, n) N·m.

    The variance is that of all samples: a joint that rests for a while has a variance near zero then, and any error
    would look enormous.
    """
    episodes = samples.episodes()
    by_episode = FEWEST_EPISODES <= len(episodes) <= MOST_EPISODES
    if not by_episode:
        edges = np.linspace(0, len(samples), min(EQUAL, len(samples)) + 1).astype(np.int64).tolist()
        episodes = [slice(first, last) for first, last in pairwise(edges)]
    squared = (samples.tau - mean) ** 2
    varies = np.ptp(samples.tau, axis=0) > 0  # rounding gives a constant column a variance above zero
    variance = samples.tau.var(axis=0)
    means = np.array([squared[each].mean(axis=0) for each in episodes])
    return Stretches(
        kind="episodes" if by_episode else "equal",
        samples=[each.stop - each.start for each in episodes],
        nmse=[
            (column / variance[joint]).tolist() if varies[joint] else [None] * len(episodes)
            for joint, column in enumerate(means.T)
        ],
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
    all_of_it = request.part == "all"
    recorded = (measured if all_of_it else held_out)(loaded, request.dataset, served)
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
        in_training=all_of_it and recorded.in_training_of(served),
    )
