"""Calls about learning from measured torques."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from lipserve.call import Call, Page, Route, given, nothing, page, record, route
from lipserve.records.jobs import Job
from lipserve.records.learning import Alarm, Decided, Learning, Quality, RolledBack
from lipserve.records.observations import Observation, ObservationDetail, ObservationResponse, Replayed, Unlearnt
from lipserve.records.payloads import Payloads
from lipserve.results.series import Live, read_live

BATCH = "/v1/models/{model}/observations/{stream_id}/{sequence}"
PAYLOAD = "/v1/models/{model}/payload"


@route("POST", "/v1/models/{model}/observations", repeatable=True)
def observe(
    at: Route,
    model: str,
    stream_id: str,
    sequence: int,
    q: ArrayLike,
    dq: ArrayLike,
    tau: ArrayLike,
    ddq: ArrayLike | None = None,
    t: ArrayLike | None = None,
    joint_names: Sequence[str] | None = None,
) -> Call[ObservationResponse]:
    """Teach a model with measured rows, arrays of shape (N, n) or (n,), times (N,); repeat it until it is answered.

    A number that is not finite keeps its row out of learning. Raise ApiError where the batch is refused.
    """
    body: dict[str, Any] = {"stream_id": stream_id, "sequence": sequence}
    for name, values in (("t", t), ("q", q), ("dq", dq), ("ddq", ddq), ("tau", tau)):
        if values is not None:
            numbers = np.asarray(values, dtype=np.float64)
            sendable = numbers.astype(object)
            sendable[~np.isfinite(numbers)] = None  # JSON has no such numbers
            body[name] = sendable.tolist()
    body |= given(joint_names=None if joint_names is None else list(joint_names))
    return at(record(ObservationResponse), names={"model": model}, json=body)


@route("GET", "/v1/models/{model}/observations")
def observations(
    at: Route, model: str, stream_id: str | None = None, rejected: bool = False
) -> Call[Page[Observation]]:
    """The batches of a model's log, newest first; rejected: only those with rows that were kept out."""
    params = {"stream_id": stream_id, "rejected": rejected or None}
    return at(page(Observation), names={"model": model}, params=params)


@route("GET", BATCH)
def observation(at: Route, model: str, stream_id: str, sequence: int, rows: bool = False) -> Call[ObservationDetail]:
    """One batch, with its rows where asked for."""
    names = {"model": model, "stream_id": stream_id, "sequence": sequence}
    return at(record(ObservationDetail), names=names, params={"rows": rows})


@route("DELETE", BATCH)
def unlearn(at: Route, model: str, stream_id: str, sequence: int) -> Call[Unlearnt]:
    """Take a batch out of what is learnt."""
    return at(record(Unlearnt), names={"model": model, "stream_id": stream_id, "sequence": sequence})


@route("POST", BATCH + "/replay")
def replay(at: Route, model: str, stream_id: str, sequence: int, codes: Sequence[str] | None = None) -> Call[Replayed]:
    """Learn rows of a batch after all that were kept out, by these codes or by any."""
    body = given(codes=None if codes is None else list(codes))
    return at(record(Replayed), names={"model": model, "stream_id": stream_id, "sequence": sequence}, json=body)


@route("POST", "/v1/models/{model}/rollback")
def rollback(at: Route, model: str, revision: int | None = None, version: int | None = None) -> Call[RolledBack]:
    """Go back to a revision of the version that serves, or to another version: name one of the two."""
    return at(record(RolledBack), names={"model": model}, json=given(revision=revision, version=version))


@route("POST", "/v1/models/{model}/refresh")
def refresh(at: Route, model: str) -> Call[Job]:
    """Queue a job that trains the version that serves anew, with what has been observed since."""
    return at(record(Job), names={"model": model}, json={})


@route("GET", "/v1/models/{model}/quality")
def quality(at: Route, model: str) -> Call[Quality]:
    """How well a model predicts what it has not learnt yet, over sliding windows."""
    return at(record(Quality), names={"model": model})


@route("GET", "/v1/models/{model}/learning")
def learning(at: Route, model: str) -> Call[Learning]:
    """How a model learns, and where that stands."""
    return at(record(Learning), names={"model": model})


@route("PUT", "/v1/models/{model}/learning")
def put_learning(at: Route, model: str, options: Mapping[str, Any]) -> Call[Learning]:
    """Set how a model learns: all options, those left out to their defaults. See `set_learning`."""
    return at(record(Learning), names={"model": model}, json=dict(options))


@route("POST", "/v1/models/{model}/learning/change")
def decide(at: Route, model: str, decision: Literal["adapt", "ignore"], replay: bool = False) -> Call[Decided]:
    """End a hold: `adapt` to the changed robot, or `ignore`. replay: learn the rows that were kept out since."""
    return at(record(Decided), names={"model": model}, json={"decision": decision, "replay": replay})


@route("GET", PAYLOAD)
def payload(at: Route, model: str) -> Call[Payloads]:
    """What the arms of a model's streams carry, with what is not known of it."""
    return at(record(Payloads), names={"model": model})


@route("PUT", PAYLOAD)
def declare_payload(
    at: Route,
    model: str,
    mass: float,
    com: ArrayLike,
    inertia: ArrayLike | None = None,
    stream_id: str | None = None,
) -> Call[Payloads]:
    """Answer with a payload from now on: mass, kg, and com, (3) m, in the frame of the last link; inertia, (3, 3)
    kg·m², about com, that of a point where None. stream_id: which robot carries it, all of the model where None."""
    shape = None if inertia is None else np.asarray(inertia, np.float64).tolist()
    body = {"mass": float(mass), "com": np.asarray(com, np.float64).tolist()}
    return at(record(Payloads), names={"model": model}, json=body | given(inertia=shape, stream_id=stream_id))


@route("DELETE", PAYLOAD)
def remove_payload(at: Route, model: str, stream_id: str | None = None) -> Call[Payloads]:
    """Answer without a payload from now on, a stream or all of them."""
    return at(record(Payloads), names={"model": model}, params={"stream_id": stream_id})


@route("DELETE", "/v1/models/{model}/streams/{stream_id}")
def delete_stream(at: Route, model: str, stream_id: str) -> Call[None]:
    """Forget a stream. What it has taught stays learnt."""
    return at(nothing, names={"model": model, "stream_id": stream_id}, removes=True)


@route("GET", "/v1/models/{model}/alarms")
def alarms(at: Route, model: str) -> Call[Page[Alarm]]:
    """A model's alarms, newest first."""
    return at(page(Alarm), names={"model": model})


@route("GET", "/v1/models/{model}/live")
def live(at: Route, model: str) -> Call[Live]:
    """What streams and batches bring to a model, predicted before it is learnt, as it comes: until the service stops.

    Of the rows some are shown and all are counted. Whoever reads too slowly is told how much was `lost`.
    """
    return at(read_live, names={"model": model})
