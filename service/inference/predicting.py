"""Torque queries: decode, check, answer and encode them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite
from typing import Any, NamedTuple

import msgspec
import numpy as np
from msgspec import MsgspecError, Struct
from numpy.typing import NDArray

from lipcore.data.motion import Motion
from lipcore.model import dynamics
from lipcore.model.functionals import Estimate
from lipcore.model.payload import NoArmError
from lipcore.model.torque_model import TorqueModel
from lipcore.vocabulary import ROBOT_ESTIMATORS, ComponentName, offered_components
from service.contract.decoding import HotDecoder, struct_of
from service.contract.payload import Payload
from service.contract.predictions import History, PredictRequest, PredictResponse
from service.foundation.errors import invalid_request
from service.models.served import ServedModel
from service.storage.storage import Storage

Array = NDArray[np.float64]
Buffer = bytes | memoryview
MAX_BATCH, MAX_COMPONENT_BATCH = 1000, 100
"""Maximum queries of one prediction request, and of one with components."""
MAX_BINARY_BATCH = 100_000
"""Maximum queries of an inference request whose tensors are binary. The size of its body limits it, too."""
MAX_SHORT_BATCH = 64
"""Maximum queries of a request that is answered at once. With covariance or components it has one."""
MAX_SHORT_BODY = 32 * 1024
"""Maximum bytes of a JSON body that is decoded at once: `MAX_SHORT_BATCH` queries of seven joints."""
MAX_HISTORY = 1000
"""Maximum rows of the motion before a query."""
QUANTITIES = ("q", "dq", "ddq", "tau")
FORWARD: ComponentName = "forward_dynamics"


class Query(NamedTuple):
    """Motions of a torque query, from JSON, tensors or a frame.

    `values` contains q, dq, ddq and, if needed, tau: (3 or 4, N, n) in SI units. If `single`, the request was one query
    without a query axis, and so is its answer. `within` is the path to these fields, such as `history.`.
    """

    values: Array
    single: bool
    within: str = ""

    def check(self, limits: Array, expected: Callable[[str], str] = lambda _: "a finite number") -> None:
        """Raise InvalidRequestError if a number is not finite or a position exceeds ±`limits`, (n,) rad (m).

        `expected` returns what a value of q, dq, ddq or tau must be.
        """
        if not np.isfinite(self.values).all():
            part, row, joint = np.argwhere(~np.isfinite(self.values))[0]
            number = f"{self.values[part, row, joint]:g}"
            raise invalid_request(self._name(QUANTITIES[part], row, joint), number, expected(QUANTITIES[part]))
        beyond = np.abs(self.values[0]) - limits
        if beyond.max() > 0:
            row, joint = np.unravel_index(beyond.argmax(), beyond.shape)
            within = f"radians (or metres) within ±{limits[joint]:g}: are these degrees?"
            raise invalid_request(self._name("q", row, joint), f"{self.values[0, row, joint]:g}", within)

    def components(
        self, model: TorqueModel, names: Sequence[ComponentName], deflections: Array | None = None
    ) -> dict[str, Estimate]:
        """Return estimates of dynamics components by name, (N, …) each; torque is used by forward dynamics alone.

        deflections: as in `Motion`. Raise InvalidRequestError if an inertia matrix cannot be inverted.
        """
        parts = self.values if FORWARD in names else self.values[:3]
        q, dq, ddq, *tau = parts
        try:
            return dynamics.components(model, Motion(q, dq, ddq, deflections), names, *tau)
        except dynamics.IndefiniteInertiaError as error:
            raise invalid_request(
                "q" if self.single else f"q[{error.index}]",
                "a posture in which the learnt inertia matrix is not positive definite",
                f"for {FORWARD} a posture near the training data",
            ) from error

    def _name(self, name: str, row: np.intp, joint: np.intp) -> str:
        return f"{self.within}{name}[{joint}]" if self.single else f"{self.within}{name}[{row}][{joint}]"


def check_shapes(request: Any, model: TorqueModel, within: str = "") -> list[Array]:
    """Return the arrays q, dq, ddq and tau of a request without those that are None or that it does not have.

    Raise InvalidRequestError if their shapes differ or do not match the model's joints. within: see `Query`.
    """
    parts = {name: values for name in QUANTITIES if (values := getattr(request, name, None)) is not None}
    for name, values in parts.items():
        field = f"{within}{name}"
        if values.shape[-1] != model.n_joints:
            given, names = values.shape[-1], ", ".join(model.joint_names)
            message = f"`{field}` has {given} values; this model has {model.n_joints} joints: {names}."
            raise invalid_request(field, f"{given} values", f"{model.n_joints} values: {names}", message)
        if values.shape != request.q.shape:
            message = f"`{field}` has shape {values.shape}; `{within}q` has shape {request.q.shape}."
            expected = f"the shape of {within}q, {request.q.shape}"
            raise invalid_request(field, f"of shape {values.shape}", expected, message)
    return list(parts.values())


def check_times(request: Any, rows: int, within: str = "") -> None:
    """Raise InvalidRequestError unless there is a time `t` for each of the rows. within: see `Query`."""
    given, field = len(request.t), f"{within}t"
    if given != rows:
        message = f"`{field}` has {given} values; `{within}q` has {rows} rows."
        raise invalid_request(field, f"{given} values", f"{rows} values, one for each row", message)


def check_answer(name: str, values: Array) -> None:
    """Raise InvalidRequestError if a number of an answer, of any shape, is not finite."""
    if isfinite(np.vdot(values, values)):  # for one query this takes a third of the time of np.isfinite
        return
    wrong = np.argwhere(~np.isfinite(values))
    if len(wrong):  # else only their squares overflow
        place = tuple(wrong[0])
        expected = "a finite number: are dq in rad/s and ddq in rad/s²?"
        field = name + "".join(f"[{index}]" for index in place)
        raise invalid_request(field, f"{values[place]:g}", expected)


def check_offered(model: TorqueModel, components: Sequence[ComponentName]) -> None:
    """Raise InvalidRequestError for a component that the model's estimator does not offer."""
    offered = offered_components(model.estimator.name)
    for index, name in enumerate(components):
        if name not in offered:
            expected = f"a component of estimator {model.estimator.name}: {', '.join(offered)}"
            raise invalid_request(f"components[{index}]", name, expected)


def check_count(field: str, given: Any, count: int, components: bool, noun: str = "") -> None:
    """Raise InvalidRequestError for too many queries in one request; `given` is the value of the field."""
    most, kind = (MAX_COMPONENT_BATCH, " with components") if components else (MAX_BATCH, "")
    if count > most:
        raise invalid_request(field, given, f"at most {most}{noun} in one request{kind}")


def check_torque(given: bool, needed: bool, users: str, place: str) -> None:
    """Raise InvalidRequestError if tau is missing but needed, or given but not needed.

    `users` are the components that need it, `place` the field that requests them.
    """
    if needed and not given:
        raise invalid_request("tau", "missing", "torque with the shape of q", f"`tau` is required for {users}.")
    if given and not needed:
        message = f"`tau` is used only for {users}, which is not among the {place}."
        raise invalid_request("tau", "given", f"no tau, or {users} among the {place}", message)


def model_with_payload(served: ServedModel, payload: Payload | None) -> TorqueModel:
    """Return a version's model with this payload, or its default model if None.

    Raise InvalidRequestError if the version has no rigid bodies, or several arms, or the payload is no possible body.
    """
    if payload is None:
        return served.default_model
    try:
        return served.declared_payloads.model(payload.numbers)
    except NoArmError as error:
        expected = f"no payload, or a model of one arm, of estimator {' or '.join(ROBOT_ESTIMATORS)}"
        message = f"`payload` needs a model with rigid bodies; estimator {served.model.estimator.name} has none."
        if served.model.arms:
            message = f"`payload` is not possible: {error}."
        raise invalid_request("payload", "given", expected, message) from None
    except ValueError as error:  # the message starts with a payload field and ends with what was expected
        name, text = str(error).partition(" ")[0], str(error).rpartition("expected ")[2]
        raise invalid_request(f"payload.{name}", payload.model_dump(mode="json")[name], text) from error


def known_deflections(request: PredictRequest, query: Query, model: TorqueModel, limits: Array) -> Array | None:
    """Return the deflections of a query by the motion before its rows, (N, 2 K, n) as in `Motion`.

    Return None if the motion before them is unknown or the model does not remember it. Raise InvalidRequestError if
    `t`, `trajectory` or `history` is wrong. limits: see `Query.check`.
    """
    _check_order(request, query.single)
    if request.t is None:
        return None
    rows = query.values.shape[1]
    check_times(request, rows)
    _check_rising(request.t, "t")
    motion = [request.t, query.values[0], query.values[1]]
    if request.history is not None:
        before = _read_history(request.history, model, limits)
        start, end = request.t[0], before[0][-1]
        if start <= end:
            message = f"`t` begins at {start:.9g}; it must be after {end:.9g}, the end of the history."
            raise invalid_request("t[0]", f"{start:.9g}", f"a time after {end:.9g}, the end of the history", message)
        motion = [np.concatenate(parts) for parts in zip(before, motion, strict=True)]
    deflections = model.deflections_along(*motion)
    return None if deflections is None else deflections[-rows:]


def _check_order(request: PredictRequest, single: bool) -> None:
    """Raise InvalidRequestError if `t`, `trajectory` and `history` do not belong together."""
    ordered, history = request.trajectory, request.history is not None
    if ordered and single:
        message = "`trajectory` needs a batch of rows in order of time; this is one query."
        raise invalid_request("trajectory", "true", "false for one query", message)
    if history and not (ordered or single):
        message = "`history` of a batch needs `trajectory`: true. Otherwise each row is a query alone."
        raise invalid_request("history", "given", "no history, or a trajectory", message)
    if request.t is None and (ordered or history):
        message = "`t` is required for `trajectory` and `history`."
        raise invalid_request("t", "missing", "times of the rows, s", message)
    if request.t is not None and not (ordered or history):
        message = "`t` is used only for `trajectory` and `history`."
        raise invalid_request("t", "given", "no t, or a trajectory or history", message)


def _read_history(history: History, model: TorqueModel, limits: Array) -> tuple[Array, Array, Array]:
    """Return t, q and dq of the motion before a query; raise InvalidRequestError."""
    within, rows, given = "history.", len(history.q), history.q.shape
    if rows > MAX_HISTORY:
        raise invalid_request("history.q", f"{rows} rows", f"at most {MAX_HISTORY}")
    if len(given) == 1:
        message = f"`history.q` has shape {given}; it must be a list of rows."
        raise invalid_request("history.q", f"of shape {given}", "rows of positions, (N, n)", message)
    Query(np.stack(check_shapes(history, model, within)), False, within).check(limits)
    check_times(history, rows, within)
    _check_rising(history.t, "history.t")
    return history.t, history.q, history.dq


def _check_rising(t: Array, field: str) -> None:
    """Raise InvalidRequestError for the first of the times (N,) that is not after the one before."""
    wrong = np.flatnonzero(t[1:] <= t[:-1])
    if len(wrong):
        last = int(wrong[0])
        expected = f"a time after {field}[{last}], {t[last]:.9g}"
        raise invalid_request(f"{field}[{last + 1}]", f"{t[last + 1]:.9g}", expected)


queries: HotDecoder[PredictRequest] = HotDecoder(PredictRequest)
_Response: Callable[..., Struct] = struct_of(PredictResponse)
_encoder = msgspec.json.Encoder()


class VersionOfBody(Struct):
    """The fields of a query that choose the version, decoded without its numbers."""

    version: int | None = None
    alias: str | None = None
    min_revision: int | None = None


_versions = msgspec.json.Decoder(VersionOfBody)


def version_of(body: bytes) -> VersionOfBody | None:
    """Return the version that a JSON body chooses, None if the body is invalid. It does not check other fields."""
    try:
        return _versions.decode(body)
    except (MsgspecError, RecursionError, ValueError):
        return None


def is_long(query: Any) -> bool:
    """Return whether a decoded query takes so long that it must not be answered beside control loops."""
    rows = len(query.q) if query.q and isinstance(query.q[0], list) else 1
    return rows > (1 if query.covariance or query.components else MAX_SHORT_BATCH)


def one_motion(query: Any) -> Array | None:
    """Return the motion (3, n) of a decoded query; None if it requests more than the torque of one motion."""
    batch = bool(query.q) and isinstance(query.q[0], list)
    if batch or query.covariance or query.components or query.tau is not None:
        return None
    if query.history is not None or query.t is not None or query.trajectory:
        return None
    try:
        return np.array((query.q, query.dq, query.ddq), np.float64)
    except ValueError:  # shapes differ
        return None


def encode(answer: Struct) -> bytes:
    """Encode a PredictResponse without the fields that were not requested; decoding returns the same numbers."""
    return _encoder.encode(answer)


def predict_now(
    served: ServedModel, motion: Array, max_position: float, payload: Payload | None = None
) -> Struct | None:
    """Return a PredictResponse to one motion (3, n), for the event loop.

    Return None if the motion or the answer is invalid, or if the payload's model must be made first.
    """
    model = served.default_model if payload is None else served.declared_payloads.cached(payload.numbers)
    if model is None or motion.shape[1] != model.n_joints:
        return None
    if (abs(motion[0]) > served.model.position_limits(max_position)).any():
        return None
    answer = model.answer_fully(motion)
    assert answer.tau_std is not None  # present unless the caller declines it
    tau, tau_std = answer.tau.tolist(), answer.tau_std.tolist()
    if not isfinite(sum(tau) + sum(tau_std)):
        return None
    return _answer(served, tau, tau_std, None if answer.fallback is None else answer.fallback.share.tolist())


def predict_body(storage: Storage, served: ServedModel, body: Buffer) -> bytes | None:
    """Return the encoded PredictResponse to a JSON body, None if the body may be invalid; raise InvalidRequestError."""
    query = queries.decode(bytes(body))
    request = None if query is None else queries.request(query)
    return None if request is None else predict(storage, served, request)


def predict(storage: Storage, served: ServedModel, request: PredictRequest) -> bytes:
    """Return the encoded PredictResponse to the queries; raise InvalidRequestError."""
    known = served.model
    single = request.q.ndim == 1
    check_offered(known, request.components)
    check_torque(request.tau is not None, FORWARD in request.components, FORWARD, "components")
    parts = check_shapes(request, known)
    query = Query(np.stack([np.atleast_2d(values) for values in parts]), single)
    count = query.values.shape[1]
    check_count("q", f"{count} queries", count, bool(request.components))
    limits = served.model.position_limits(storage.settings.max_position)
    query.check(limits)
    known = model_with_payload(served, request.payload)
    deflections = known_deflections(request, query, known, limits)

    q, dq, ddq, *_ = query.values
    answer = known.predict(q, dq, ddq, request.covariance, deflections)
    arrays = {"tau": answer.tau, "tau_std": answer.tau_std}
    if answer.covariance is not None:
        arrays["covariance"] = answer.covariance
    if answer.fallback is not None:
        arrays["fallback"] = answer.fallback.share
    lists: dict[str, Any] = {}
    for name, values in arrays.items():
        shaped = values[0] if single else values
        check_answer(name, shaped)
        lists[name] = shaped.tolist()
    if request.components:
        of_query = 0 if single else slice(None)
        estimates = query.components(known, request.components, deflections)
        lists["components"] = {
            name: {part: getattr(estimates[name], part)[of_query].tolist() for part in ("mean", "std")}
            for name in request.components
        }
    return encode(_answer(served, **lists))


def _answer(
    served: ServedModel,
    tau: list[Any],
    tau_std: list[Any],
    fallback: list[Any] | None = None,
    covariance: list[Any] | None = None,
    components: dict[str, Any] | None = None,
) -> Struct:
    model = served.model
    return _Response(
        model=served.name,
        version=served.version,
        revision=served.revision,
        joint_names=model.joint_names,
        torque_convention=model.torque_convention,
        tau=tau,
        tau_std=tau_std,
        noise_std=served.noise_std,
        scale=served.scales.default_factors,
        guaranteed=served.guaranteed,
        covariance=covariance,
        components=components,
        fallback=fallback,
    )
