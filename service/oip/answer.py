"""From the bytes of a request to the bytes of its answer: no transport here."""

from __future__ import annotations

from service.foundation.errors import invalid_request
from service.foundation.settings import Settings
from service.inference import checks
from service.models.loaded import Served
from service.oip import outputs, wire
from service.oip.outputs import Array
from service.oip.query import Query, read
from service.oip.schema import AnswerParameters, InferRequest, InferResponse, InferTensor, TensorParameters
from service.oip.wire import Headers, Message
from service.web.route import Reply


def infer(served: Served, body: bytes, headers: Headers, settings: Settings) -> Reply:
    """Answer a request; raise InvalidRequestError or UnsupportedMediaTypeError. Not for the event loop."""
    message = wire.decode(body, headers)
    return respond(served, message.request, question(served, message, body, settings))


def question(served: Served, message: Message, body: bytes, settings: Settings) -> Query:
    """Check a request and read its query; raise InvalidRequestError."""
    request = message.request
    for field, value, expected in (
        ("model_name", request.model_name, served.name),
        ("model_version", request.model_version, str(served.version)),
    ):
        if value not in (None, expected):
            raise invalid_request(field, value, f"that which the path leads to, {expected}")
    return read(message, body, served.model, settings)


def respond(served: Served, request: InferRequest, query: Query) -> Reply:
    """Compute the answer to a query and encode it; raise InvalidRequestError."""
    found = outputs.compute(served.model, query.motion, frozenset(query.outputs), query.tau)
    tensors: list[InferTensor] = []
    payload: list[bytes] = []
    for name, binary in query.outputs.items():
        values = found[name]
        if query.single and name != "noise_std":
            values = values[0]
        checks.answer(name, values)
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
