"""From a query to the bytes of its answer: what a model can answer, and computing what is asked for."""

from __future__ import annotations

import numpy as np

from lipcore.model.torque_model import TorqueModel
from service.foundation.errors import invalid_request
from service.foundation.settings import Settings
from service.inference.predicting import Query, check_answer
from service.models.loaded import Served
from service.oip import wire
from service.oip.query import PARTS, Array, Question, read
from service.oip.schema import AnswerParameters, InferRequest, InferResponse, InferTensor, TensorParameters
from service.oip.wire import Headers, Message
from service.web.route import Reply


def compute(model: TorqueModel, query: Query, names: frozenset[str]) -> dict[str, Array]:
    """Tensors by name, their first axis N, noise_std (n,) apart; nothing is computed that they do not need.

    Raise InvalidRequestError where inertia cannot be inverted.
    """
    tensors = _torques(model, query.values[:3], names)
    if "noise_std" in names:
        tensors["noise_std"] = model.noise_std
    parts = {name: PARTS[name] for name in names if name in PARTS}
    if parts:
        estimates = query.components(model, sorted({part.component for part in parts.values()}))
        for name, part in parts.items():
            estimate = estimates[part.component]
            values: Array = (estimate.std if part.std else estimate.mean).numpy()
            tensors[name] = values[:, None] if values.ndim == 1 else values
    return tensors


def _torques(model: TorqueModel, motion: Array, names: frozenset[str]) -> dict[str, Array]:
    """motion: q, dq and ddq, (3, N, n)."""
    if "covariance" in names:
        batch = model.predict(motion[0], motion[1], motion[2], covariance=True)
        assert batch.covariance is not None  # it is asked for
        return {"tau": batch.tau, "tau_std": batch.tau_std, "covariance": batch.covariance}
    if "tau_std" in names and motion.shape[1] > 1:
        batch = model.predict(motion[0], motion[1], motion[2])
        return {"tau": batch.tau, "tau_std": batch.tau_std}
    if "tau_std" in names:
        tau, std = model.answer(motion[:, 0])
        assert std is not None  # it is asked for
        return {"tau": tau[None], "tau_std": std[None]}
    if "tau" in names:  # the mean of one query costs less than its share of a batch with standard deviations
        each = np.ascontiguousarray(motion.transpose(1, 0, 2))
        return {"tau": np.stack([model.answer(one, std=False)[0] for one in each])}
    return {}


def infer(served: Served, body: bytes, headers: Headers, settings: Settings) -> Reply:
    """Answer a request; raise InvalidRequestError or UnsupportedMediaTypeError. Not for the event loop."""
    message = wire.decode(body, headers)
    return respond(served, message.request, read_question(served, message, body, settings))


def read_question(served: Served, message: Message, body: bytes, settings: Settings) -> Question:
    """Check a request and read its query; raise InvalidRequestError."""
    request = message.request
    for field, value, expected in (
        ("model_name", request.model_name, served.name),
        ("model_version", request.model_version, str(served.version)),
    ):
        if value not in (None, expected):
            raise invalid_request(field, value, f"that which the path leads to, {expected}")
    return read(message, body, served.model, settings)


def respond(served: Served, request: InferRequest, question: Question) -> Reply:
    """Compute the answer to a query and encode it; raise InvalidRequestError."""
    values_of = compute(served.model, question.query, frozenset(question.outputs))
    tensors: list[InferTensor] = []
    payload: list[bytes] = []
    for name, binary in question.outputs.items():
        values = values_of[name]
        if question.query.single and name != "noise_std":
            values = values[0]
        check_answer(name, values)
        tensors.append(_tensor(name, values, payload if binary else None))
    response = InferResponse(
        served.name,
        str(served.version),
        AnswerParameters(served.revision, served.model.torque_convention),
        tensors,
    )
    if request.id is not None:
        response.id = request.id
    return wire.encode(response, payload)


def _tensor(name: str, values: Array, payload: list[bytes] | None) -> InferTensor:
    """Describe a tensor that lies in the JSON, or at the end of the payload."""
    shape = list(values.shape)
    if payload is None:
        return InferTensor(name, "FP64", shape, data=values.ravel().tolist())
    data = values.astype("<f8", copy=False).tobytes()
    payload.append(data)
    return InferTensor(name, "FP64", shape, TensorParameters(len(data)))
