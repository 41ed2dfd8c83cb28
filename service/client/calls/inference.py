"""Calls that ask a model for torques, or how well it knows them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from service.client.call import Call, Route, given, route
from service.client.results.evaluation import Comparison, Evaluation, read_comparison, read_evaluation
from service.client.results.prediction import Prediction, read_prediction
from service.client.results.trace import Trace, read_trace


@route("POST", "/v1/models/{model}/predict", repeatable=True)
def predict(
    at: Route,
    model: str,
    q: ArrayLike,
    dq: ArrayLike,
    ddq: ArrayLike,
    version: int | None = None,
    covariance: bool = False,
    components: Sequence[str] = (),
    tau: ArrayLike | None = None,
    alias: str | None = None,
    min_revision: int | None = None,
) -> Call[Prediction]:
    """Torque for arrays of shape (n,) or (N, n), and components by name; tau is for `forward_dynamics` only.

    The version that serves answers, unless one is named by its number or an alias. min_revision: of an acknowledgement,
    so that the answer contains what was taught, whichever service took it; refused with 503 where it takes too long.
    """
    body: dict[str, Any] = {"covariance": covariance, "components": list(components)}
    for name, values in (("q", q), ("dq", dq), ("ddq", ddq), ("tau", tau)):
        if values is not None:
            body[name] = np.asarray(values, dtype=np.float64).tolist()
    body |= given(version=version, alias=alias, min_revision=min_revision)
    return at(read_prediction, names={"model": model}, json=body)


@route("POST", "/v1/models/{model}/evaluate", repeatable=True)
def evaluate(
    at: Route,
    model: str,
    dataset: str,
    version: int | None = None,
    alias: str | None = None,
    part: Literal["all", "held_out"] = "all",
    min_revision: int | None = None,
) -> Call[Evaluation]:
    """Compare a model with a data set: the version that serves, unless one is named by its number or an alias.

    part: `held_out` compares with what the version's training has held out of the data set. min_revision: as of
    `predict`.
    """
    body = {"dataset": dataset, "part": part} | given(version=version, alias=alias, min_revision=min_revision)
    return at(read_evaluation, names={"model": model}, json=body)


@route("POST", "/v1/models/{model}/compare", repeatable=True)
def compare(at: Route, model: str, dataset: str, first: int | str, second: int | str) -> Call[Comparison]:
    """Compare two versions, each a number or an alias, on a data set."""
    body = {"dataset": dataset, "versions": [first, second]}
    return at(read_comparison, names={"model": model}, json=body)


@route("POST", "/v1/models/{model}/trace", repeatable=True)
def trace(
    at: Route,
    model: str,
    dataset: str,
    version: int | None = None,
    alias: str | None = None,
    part: Literal["all", "held_out"] = "all",
    start: int = 0,
    stop: int | None = None,
    points: int = 1000,
    components: Sequence[str] = (),
) -> Call[Trace]:
    """Measured torque beside the model's at rows of a data set, evenly chosen where there are more than `points`.

    start, stop: first row and the one to end before; components: parts of the torque by name.
    """
    body = {"dataset": dataset, "part": part, "start": start, "points": points, "components": list(components)}
    body |= given(version=version, alias=alias, stop=stop)
    return at(read_trace, names={"model": model}, json=body)
