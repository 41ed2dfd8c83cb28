"""From tensors to a query, and from that to the tensors of its answer, whatever the transport: all is checked, nothing
guessed, and nothing computed that was not asked for."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lipcore.model.dynamics import available_components
from lipcore.model.external import external
from lipcore.model.torque_model import TorqueAnswer, TorqueModel, TorquePrediction
from lipcore.vocabulary import COMPONENTS, ComponentName
from service.api.oip import schema
from service.api.oip.tensors import Answer, Header, Message
from service.api.route import Reply
from service.foundation.errors import invalid_request
from service.foundation.settings import Settings
from service.inference.predicting import FORWARD, QUANTITIES, Query, check_answer, check_count, check_torque
from service.models.loaded import ServedModel

Array = NDArray[np.float64]
Shape = tuple[int, ...]

DEFAULT = ("tau", "tau_std")
OF_MODEL = frozenset({"noise_std", "scale"})
"""Outputs that are the same for all queries, (n,)."""
OF_ARM = {"tau_external_statistic": "statistic", "tau_external_p": "p"}
"""Outputs of external torque that are one number a query, which take a covariance."""
EXTERNAL = {"tau_external": "tau", "tau_external_std": "std", "tau_external_z": "z"} | OF_ARM
"""Outputs of external torque, and what of `External` they are."""
FALLBACK = "fallback"
"""Output with the shares of the fallback in `tau`."""
_MEAN = "mean"
"""Posterior mean, which is no output: external torque is compared with it."""
QUICK = OF_MODEL | EXTERNAL.keys() | {"tau", "tau_std", FALLBACK}
"""Outputs of which one query is answered on the event loop."""
_STD = "_std"
_TORQUES = ("gravity", "coriolis", "inertial", "friction")


class ComponentTensor(NamedTuple):
    """A component as a tensor: its mean, or its standard deviation."""

    component: ComponentName
    std: bool


PARTS: dict[str, ComponentTensor] = {
    (f"tau_{name}" if name in _TORQUES else name) + suffix: ComponentTensor(name, bool(suffix))
    for name in COMPONENTS
    for suffix in ("", _STD)
}
"""Tensors of components by name; components that are torques begin with `tau_`."""
NEED_TORQUE = {name for name, part in PARTS.items() if part.component == FORWARD} | EXTERNAL.keys()


def shapes(model: TorqueModel) -> dict[str, Shape]:
    """Every tensor that a model can answer, and its shape at N queries; -1 stands for N."""
    n, offered = model.n_joints, available_components(model.estimator)
    tensors: dict[str, Shape] = {"tau": (-1, n), "tau_std": (-1, n), "covariance": (-1, n, n), FALLBACK: (-1, n)}
    tensors |= dict.fromkeys(sorted(OF_MODEL), (n,))
    tensors |= {name: (-1, 1) if name in OF_ARM else (-1, n) for name in EXTERNAL}
    for name, part in PARTS.items():
        if part.component in offered:
            tensors[name] = _shape(part.component, n)
    return tensors


def _shape(component: ComponentName, n: int) -> Shape:
    if component == "inertia_matrix":
        return (-1, n, n)
    # an energy is a tensor of one number a query: not every client takes a tensor without axes
    return (-1, 1) if component in ("kinetic_energy", "potential_energy") else (-1, n)


_DTYPES: dict[str, np.dtype[np.floating]] = {"FP64": np.dtype("<f8"), "FP32": np.dtype("<f4")}
_NO_TENSORS = f"tensors in the body: of the extensions, {schema.BINARY} is supported"


class Question(NamedTuple):
    """What to compute, and how to answer it: names of outputs in the order asked for, each with whether it is answered
    in binary."""

    query: Query
    outputs: dict[str, bool]

    @property
    def quick(self) -> bool:
        """Whether the answer is one of a control loop: one query, and of it torques alone."""
        return self.query.values.shape[1] == 1 and self.outputs.keys() <= QUICK


def read(message: Message, model: TorqueModel, settings: Settings) -> Question:
    """Turn a request into a question; raise InvalidRequestError."""
    request = message.request
    outputs = _outputs(request, model)
    tensors = _inputs(request, bool(NEED_TORQUE & outputs.keys()))
    shape = request.inputs[0].shape
    _check_shape(request.inputs[0], shape, model, bool(PARTS.keys() & outputs.keys()))
    message.check()
    single, rows = len(shape) == 1, 1 if len(shape) == 1 else shape[0]
    values = np.empty((len(tensors), rows, model.n_joints))
    places = {name: place for place, name in enumerate(tensors)}
    for place, tensor in enumerate(request.inputs):  # binary data lie in this order, whatever that of the names
        if tensor.shape != shape:
            raise invalid_request(f"{tensor.name}.shape", tensor.shape, f"that of {request.inputs[0].name}, {shape}")
        dtype = _dtype(tensor)
        values[places[tensor.name]] = _as_read(message.numbers(place, dtype), dtype).reshape(rows, -1)
    query = Query(values, single)
    datatypes = {tensor.name: tensor.datatype for tensor in request.inputs}
    query.check(model.position_limits(settings.max_position), lambda name: f"a finite number of {datatypes[name]}")
    return Question(query, outputs)


def _outputs(request: schema.InferRequest, model: TorqueModel) -> dict[str, bool]:
    usual = bool(request.parameters and request.parameters.binary_data_output)
    if not request.outputs:
        return dict.fromkeys(DEFAULT, usual)
    outputs: dict[str, bool] = {}
    for index, output in enumerate(request.outputs):
        name, field = output.name, f"outputs[{index}]"
        if name in outputs:
            raise invalid_request(f"{field}.name", name, "each output once")
        part = PARTS.get(name)
        if (part is None or part.component not in available_components(model.estimator)) and name not in (
            *QUICK,
            "covariance",
        ):
            expected = f"what a model with the estimator {model.estimator.name} offers: {', '.join(shapes(model))}"
            raise invalid_request(f"{field}.name", name, expected)
        outputs[name] = _binary(output, field, usual)
    return outputs


def _binary(output: schema.InferOutput, field: str, usual: bool) -> bool:
    asked = output.parameters
    if asked is None:
        return usual
    for name, value in (("classification", asked.classification), ("shared_memory_region", asked.shared_memory_region)):
        if value is not None:
            raise invalid_request(f"{field}.parameters.{name}", value, _NO_TENSORS)
    return usual if asked.binary_data is None else asked.binary_data


def _inputs(request: schema.InferRequest, torque: bool) -> tuple[str, ...]:
    """Names of the tensors that the query needs; they are all there, each once, and no other."""
    needed = QUANTITIES if torque else schema.INPUTS
    names = [tensor.name for tensor in request.inputs]
    check_torque(schema.TORQUE in names, torque, f"{FORWARD} or tau_external", "outputs")
    for index, name in enumerate(names):
        if name not in needed:
            raise invalid_request(f"inputs[{index}].name", name, f"one of {', '.join(needed)}")
        if name in names[:index]:
            raise invalid_request(f"inputs[{index}].name", name, "each input once")
    for name in needed:
        if name not in names:
            raise invalid_request(name, "missing", f"the inputs {', '.join(needed)}")
    return needed


def _check_shape(tensor: schema.InferInput, shape: list[int], model: TorqueModel, components: bool) -> None:
    n, field = model.n_joints, f"{tensor.name}.shape"
    if len(shape) not in (1, 2) or shape[-1] != n or shape[0] == 0:
        joints = ", ".join(model.joint_names)
        raise invalid_request(field, shape, f"[{n}] for one query or [N, {n}] for a batch: the joints are {joints}")
    if len(shape) == 2:
        check_count(field, shape, shape[0], components, " queries")


def _dtype(tensor: schema.InferInput) -> np.dtype[np.floating]:
    """Elements of a tensor that lies in the body."""
    name, given = tensor.name, tensor.parameters
    dtype = _DTYPES.get(tensor.datatype)
    if dtype is None:
        raise invalid_request(f"{name}.datatype", tensor.datatype, " or ".join(schema.DATATYPES))
    if given is not None and given.shared_memory_region is not None:
        raise invalid_request(f"{name}.parameters.shared_memory_region", given.shared_memory_region, _NO_TENSORS)
    return dtype


def _as_read(values: NDArray[np.floating], dtype: np.dtype[np.floating]) -> Array:
    """The numbers that the datatype makes of what was sent, as FP64."""
    if dtype == np.float64:
        return values.astype(np.float64, copy=False)
    with np.errstate(over="ignore", invalid="ignore"):  # what it cannot hold becomes infinite and is refused as such
        return values.astype(dtype).astype(np.float64)


def compute(served: ServedModel, query: Query, names: frozenset[str]) -> dict[str, Array]:
    """Tensors by name, their first axis N, but for those OF_MODEL; nothing is computed that they do not need. Raise
    InvalidRequestError where inertia cannot be inverted."""
    model, scale = served.default_model, served.scales.of(None)
    compared, of_arm = names & EXTERNAL.keys(), bool(names & OF_ARM.keys())
    needed = {"covariance"} if of_arm else {"tau", "tau_std"} if compared else set()
    tensors = _torques(model, query.values[:3], names | needed)
    if names & OF_MODEL:
        tensors |= {"noise_std": model.noise_std, "scale": scale}
    if compared:
        between = tensors["covariance"] if of_arm else None
        seen = external(query.values[3], tensors[_MEAN], tensors["tau_std"], model.noise_std, scale, between)
        tensors |= {name: _rows(getattr(seen, EXTERNAL[name])) for name in compared}
    parts = {name: PARTS[name] for name in names if name in PARTS}
    if parts:
        estimates = query.components(model, sorted({part.component for part in parts.values()}))
        for name, part in parts.items():
            estimate = estimates[part.component]
            tensors[name] = _rows(estimate.std if part.std else estimate.mean)
    return tensors


def _rows(values: Array) -> Array:
    """Values of N queries with an axis besides, should they be one number each."""
    return values[:, None] if values.ndim == 1 else values


def _torques(model: TorqueModel, motion: Array, names: frozenset[str]) -> dict[str, Array]:
    """motion: q, dq and ddq, (3, N, n)."""
    wide, rows = "covariance" in names, motion.shape[1]
    if not wide and names.isdisjoint({"tau_std", FALLBACK}):
        if "tau" not in names:
            return {}
        # the mean of one query costs less than its share of a batch with standard deviations
        each = np.ascontiguousarray(motion.transpose(1, 0, 2))
        return {"tau": np.stack([model.answer(one, std=False)[0] for one in each])}
    answer: TorqueAnswer | TorquePrediction
    if rows == 1:
        answer = model.answer_fully(motion[:, 0], covariance=wide)
    else:
        answer = model.predict(motion[0], motion[1], motion[2], wide)
    share = np.zeros_like(answer.tau) if answer.fallback is None else answer.fallback.share
    tensors = {"tau": answer.tau, "tau_std": answer.tau_std, "covariance": answer.covariance}
    tensors |= {FALLBACK: share, _MEAN: answer.mean}
    return {name: each[None] if rows == 1 else each for name, each in tensors.items() if each is not None}


def infer(served: ServedModel, decode: Callable[[], Message], settings: Settings) -> Reply:
    """Answer a request that is still to be decoded; raise what decoding raises, or InvalidRequestError. Not for the
    event loop."""
    message = decode()
    return respond(served, message, read_question(served, message, settings))


def read_question(served: ServedModel, message: Message, settings: Settings) -> Question:
    """Check a request and read its query; raise InvalidRequestError."""
    request = message.request
    for field, value, expected in (
        ("model_name", request.model_name, served.name),
        ("model_version", request.model_version, str(served.version)),
    ):
        if value not in (None, expected):
            raise invalid_request(field, value, f"that which the path leads to, {expected}")
    return read(message, served.model, settings)


def respond(served: ServedModel, message: Message, question: Question) -> Reply:
    """Compute the answer to a query and encode it; raise InvalidRequestError."""
    values_of = compute(served, question.query, frozenset(question.outputs))
    answers: list[Answer] = []
    for name, binary in question.outputs.items():
        values = values_of[name]
        if question.query.single and name not in OF_MODEL:
            values = values[0]
        check_answer(name, values)
        answers.append(Answer(name, values, binary))
    parameters = schema.AnswerParameters(served.revision, served.model.torque_convention)
    return message.encode(Header(served.name, str(served.version), parameters), answers)
