"""Calls for online learning from measured torques."""

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
    _route: Route,
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
    """Send a batch of measured rows for a model to learn from.

    If the call fails, repeat it with the same sequence until it is answered. Rows with a value that is not finite are
    not learnt.

    Args:
        model: Name of the model.
        stream_id: Name of the robot or recording.
        sequence: Number of the batch in its stream, counted up by one. A repeated batch is applied once.
        q: (N, n) or (n,) positions, rad (prismatic: m).
        dq: Velocities, rad/s, shaped as q.
        tau: Measured torques, N·m (prismatic: N), shaped as q.
        ddq: Accelerations, rad/s², shaped as q; required unless t is given.
        t: (N,) times of the rows, s. Default: the time of arrival.
        joint_names: (n,) names, if the joints are in another order than the model's.

    Returns:
        Number of accepted and rejected rows, and the revision that contains the batch.

    Raises:
        ApiError: The service rejects the batch.

    Example:
        >>> client.observe("my-arm", "cell-1", 0, q, dq, tau, ddq).accepted
        30
    """
    body: dict[str, Any] = {"stream_id": stream_id, "sequence": sequence}
    for name, values in (("t", t), ("q", q), ("dq", dq), ("ddq", ddq), ("tau", tau)):
        if values is not None:
            numbers = np.asarray(values, dtype=np.float64)
            sendable = numbers.astype(object)
            sendable[~np.isfinite(numbers)] = None  # JSON has no NaN or infinity
            body[name] = sendable.tolist()
    body |= given(joint_names=None if joint_names is None else list(joint_names))
    return _route(record(ObservationResponse), names={"model": model}, json=body)


@route("GET", "/v1/models/{model}/observations")
def observations(
    _route: Route, model: str, stream_id: str | None = None, rejected: bool = False
) -> Call[Page[Observation]]:
    """List the observation batches of a model, newest first. rejected: only batches with rejected rows."""
    params = {"stream_id": stream_id, "rejected": rejected or None}
    return _route(page(Observation), names={"model": model}, params=params)


@route("GET", BATCH)
def observation(
    _route: Route, model: str, stream_id: str, sequence: int, rows: bool = False
) -> Call[ObservationDetail]:
    """Return an observation batch. rows: include its rows."""
    names = {"model": model, "stream_id": stream_id, "sequence": sequence}
    return _route(record(ObservationDetail), names=names, params={"rows": rows})


@route("DELETE", BATCH)
def unlearn(_route: Route, model: str, stream_id: str, sequence: int) -> Call[Unlearnt]:
    """Remove the effect of a batch from the model. The batch stays in the log."""
    return _route(record(Unlearnt), names={"model": model, "stream_id": stream_id, "sequence": sequence})


@route("POST", BATCH + "/replay")
def replay(
    _route: Route, model: str, stream_id: str, sequence: int, codes: Sequence[str] | None = None
) -> Call[Replayed]:
    """Learn rejected rows of a batch. codes: only rows with these codes. Default: all."""
    body = given(codes=None if codes is None else list(codes))
    return _route(record(Replayed), names={"model": model, "stream_id": stream_id, "sequence": sequence}, json=body)


@route("POST", "/v1/models/{model}/rollback")
def rollback(_route: Route, model: str, revision: int | None = None, version: int | None = None) -> Call[RolledBack]:
    """Return to a revision of the serving version, or to another version: give one of the two."""
    return _route(record(RolledBack), names={"model": model}, json=given(revision=revision, version=version))


@route("POST", "/v1/models/{model}/refresh")
def refresh(_route: Route, model: str) -> Call[Job]:
    """Queue a job that retrains the serving version with all observations since."""
    return _route(record(Job), names={"model": model}, json={})


@route("GET", "/v1/models/{model}/quality")
def quality(_route: Route, model: str) -> Call[Quality]:
    """Return the prediction errors of rows before they are learnt, over sliding windows."""
    return _route(record(Quality), names={"model": model})


@route("GET", "/v1/models/{model}/learning")
def learning(_route: Route, model: str) -> Call[Learning]:
    """Return the learning options of a model and the state of learning."""
    return _route(record(Learning), names={"model": model})


@route("PUT", "/v1/models/{model}/learning")
def put_learning(_route: Route, model: str, options: Mapping[str, Any]) -> Call[Learning]:
    """Replace all learning options of a model; missing ones get their defaults. See `set_learning`."""
    return _route(record(Learning), names={"model": model}, json=dict(options))


@route("POST", "/v1/models/{model}/learning/change")
def decide(_route: Route, model: str, decision: Literal["adapt", "ignore"], replay: bool = False) -> Call[Decided]:
    """Resume paused learning.

    Args:
        model: Name of the model.
        decision: `adapt`: the robot has changed, reduce the weight of earlier data; `ignore`: resume as before.
        replay: Also learn the rows that were rejected during the pause.
    """
    return _route(record(Decided), names={"model": model}, json={"decision": decision, "replay": replay})


@route("GET", PAYLOAD)
def payload(_route: Route, model: str) -> Call[Payloads]:
    """Return the payloads of a model's streams, with their uncertainty."""
    return _route(record(Payloads), names={"model": model})


@route("PUT", PAYLOAD)
def declare_payload(
    _route: Route,
    model: str,
    mass: float,
    com: ArrayLike,
    inertia: ArrayLike | None = None,
    stream_id: str | None = None,
) -> Call[Payloads]:
    """Declare a payload. Predictions include it from now on.

    Args:
        model: Name of the model.
        mass: Mass, kg.
        com: (3,) centre of mass in the frame of the last link, m.
        inertia: (3, 3) inertia about the centre of mass, kg·m². Default: a point mass.
        stream_id: Stream of the robot that carries it. Default: all streams of the model.
    """
    shape = None if inertia is None else np.asarray(inertia, np.float64).tolist()
    body = {"mass": float(mass), "com": np.asarray(com, np.float64).tolist()}
    return _route(record(Payloads), names={"model": model}, json=body | given(inertia=shape, stream_id=stream_id))


@route("DELETE", PAYLOAD)
def remove_payload(_route: Route, model: str, stream_id: str | None = None) -> Call[Payloads]:
    """Remove the payload of a stream, or of all streams if stream_id is None."""
    return _route(record(Payloads), names={"model": model}, params={"stream_id": stream_id})


@route("DELETE", "/v1/models/{model}/streams/{stream_id}")
def delete_stream(_route: Route, model: str, stream_id: str) -> Call[None]:
    """Delete the state of a stream. The model keeps what it learnt from it."""
    return _route(nothing, names={"model": model, "stream_id": stream_id}, removes=True)


@route("GET", "/v1/models/{model}/alarms")
def alarms(_route: Route, model: str) -> Call[Page[Alarm]]:
    """List the alarms of a model, newest first."""
    return _route(page(Alarm), names={"model": model})


@route("GET", "/v1/models/{model}/live")
def live(_route: Route, model: str) -> Call[Live]:
    """Follow observations of a model live, each predicted before it is learnt, until the service stops.

    All rows are counted, some are included. If you read too slowly, an event says how many events were lost.
    """
    return _route(read_live, names={"model": model})
