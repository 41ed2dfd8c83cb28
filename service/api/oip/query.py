"""Reads the tensors of a request into a query, and computes the requested output tensors, for any transport."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lipcore.data.motion import Motion
from lipcore.model.external import external
from lipcore.model.prediction import TorqueAnswer, TorquePrediction
from lipcore.model.torque_model import TorqueModel
from lipcore.model.wrench import has_wrench
from lipcore.vocabulary import COMPONENTS, ComponentName, offered_components
from service.api.oip import schema
from service.api.oip.sequences import Sequences, read_part
from service.api.oip.statistics import Timing
from service.api.oip.tensors import Answer, Header, Message
from service.api.route import Reply
from service.foundation.errors import invalid_request
from service.foundation.settings import Settings
from service.inference.predicting import (
    FORWARD,
    MAX_BINARY_BATCH,
    MAX_SHORT_BATCH,
    QUANTITIES,
    Buffer,
    Query,
    check_answer,
    check_count,
    check_torque,
)
from service.inference.wrench import wrenches
from service.models.loaded import ServedModel
from service.storage.storage import Storage

Array = NDArray[np.float64]
Shape = tuple[int, ...]

DEFAULT_OUTPUTS = ("tau", "tau_std")
MODEL_OUTPUTS = frozenset({"noise_std", "scale"})
"""Outputs that do not depend on the query, (n,)."""
ARM_OUTPUTS = {"tau_external_statistic": "statistic", "tau_external_p": "p"}
"""External torque outputs with one number per query. They need the covariance."""
EXTERNAL_OUTPUTS = {"tau_external": "tau", "tau_external_std": "std", "tau_external_z": "z"} | ARM_OUTPUTS
"""External torque outputs, and the property of `External` that they return."""
WRENCH_OUTPUTS = {
    "wrench_link": "link",
    "wrench_link_std": "link_std",
    "wrench_base": "base",
    "wrench_base_std": "base_std",
}
"""Outputs with six numbers per query, of models with the geometry of a URDF, and the property of `Wrench`."""
FALLBACK = "fallback"
"""Output with the share of the fallback in `tau`."""
MEAN = "tau_mean"
"""Output with the posterior mean, which never falls back. External torque is computed from it."""
TORQUE_OUTPUTS = frozenset({"tau", "tau_std", FALLBACK, MEAN})
LARGE_BATCH_OUTPUTS = MODEL_OUTPUTS | TORQUE_OUTPUTS
"""Outputs of binary batches with more than `MAX_BATCH` queries."""
INLINE_OUTPUTS = LARGE_BATCH_OUTPUTS | EXTERNAL_OUTPUTS.keys()
"""Outputs that are computed on the event loop for a single query."""
_STD = "_std"
_TORQUES = ("gravity", "coriolis", "inertial", "friction", "without_gravity")


class ComponentTensor(NamedTuple):
    """Mean or standard deviation of a component."""

    component: ComponentName
    std: bool


COMPONENT_TENSORS: dict[str, ComponentTensor] = {
    (f"tau_{name}" if name in _TORQUES else name) + suffix: ComponentTensor(name, bool(suffix))
    for name in COMPONENTS
    for suffix in ("", _STD)
}
"""Component tensors by name. Names of torque components begin with `tau_`."""
OUTPUTS_NEEDING_TORQUE = {name for name, part in COMPONENT_TENSORS.items() if part.component == FORWARD}
OUTPUTS_NEEDING_TORQUE |= EXTERNAL_OUTPUTS.keys() | WRENCH_OUTPUTS.keys()


def shapes(model: TorqueModel) -> dict[str, Shape]:
    """Return the shape of every output of a model for N queries; -1 stands for N."""
    n, offered = model.n_joints, offered_components(model.estimator.name)
    tensors: dict[str, Shape] = dict.fromkeys(("tau", "tau_std", MEAN, FALLBACK), (-1, n))
    tensors["covariance"] = (-1, n, n)
    tensors |= dict.fromkeys(sorted(MODEL_OUTPUTS), (n,))
    tensors |= {name: (-1, 1) if name in ARM_OUTPUTS else (-1, n) for name in EXTERNAL_OUTPUTS}
    if has_wrench(model):
        tensors |= dict.fromkeys(WRENCH_OUTPUTS, (-1, 6))
    for name, part in COMPONENT_TENSORS.items():
        if part.component in offered:
            tensors[name] = _shape(part.component, n)
    return tensors


def _shape(component: ComponentName, n: int) -> Shape:
    if component == "inertia_matrix":
        return (-1, n, n)
    # (-1, 1) for energies: some clients reject tensors without axes
    return (-1, 1) if component in ("kinetic_energy", "potential_energy") else (-1, n)


_DTYPES: dict[str, np.dtype[np.floating]] = {"FP64": np.dtype("<f8"), "FP32": np.dtype("<f4")}
_OTHER_EXTENSION = f"tensors in the body: the supported extensions are {', '.join(schema.EXTENSIONS)}"


class InferTask(NamedTuple):
    """A query and its requested outputs: names in the requested order, each with whether it is encoded in binary.

    deflections: those of the play elements, (N, 2 K, n), if the query belongs to a sequence and friction remembers it.
    """

    query: Query
    outputs: dict[str, bool]
    deflections: Array | None = None

    @property
    def is_inline(self) -> bool:
        """Whether the task is cheap enough for the event loop: a single query without components."""
        return self.query.values.shape[1] == 1 and self.outputs.keys() <= INLINE_OUTPUTS

    @property
    def is_long(self) -> bool:
        """Whether the task takes so long that it must not be computed beside control loops."""
        cheap = self.outputs.keys() <= INLINE_OUTPUTS - ARM_OUTPUTS.keys()
        rows: int = self.query.values.shape[1]
        return rows > (MAX_SHORT_BATCH if cheap else 1)


def read(message: Message, model: TorqueModel, settings: Settings) -> InferTask:
    """Check a request and read its inputs and outputs; raise InvalidRequestError."""
    request = message.request
    outputs = _outputs(request, model)
    tensors = _inputs(request, bool(OUTPUTS_NEEDING_TORQUE & outputs.keys()))
    shape = request.inputs[0].shape
    may_be_large = outputs.keys() <= LARGE_BATCH_OUTPUTS and message.is_binary(outputs.values())
    _check_shape(request.inputs[0], shape, model, bool(COMPONENT_TENSORS.keys() & outputs.keys()), may_be_large)
    message.check()
    single, rows = len(shape) == 1, 1 if len(shape) == 1 else shape[0]
    values = np.empty((len(tensors), rows, model.n_joints))
    places = {name: place for place, name in enumerate(tensors)}
    for place, tensor in enumerate(request.inputs):  # the order of the binary data
        if tensor.shape != shape:
            raise invalid_request(f"{tensor.name}.shape", tensor.shape, f"that of {request.inputs[0].name}, {shape}")
        dtype = _dtype(tensor)
        values[places[tensor.name]] = _as_read(message.numbers(place, dtype), dtype).reshape(rows, -1)
    query = Query(values, single)
    datatypes = {tensor.name: tensor.datatype for tensor in request.inputs}
    query.check(model.position_limits(settings.max_position), lambda name: f"a finite number of {datatypes[name]}")
    return InferTask(query, outputs)


def _outputs(request: schema.InferRequest, model: TorqueModel) -> dict[str, bool]:
    usual = bool(request.parameters and request.parameters.binary_data_output)
    if not request.outputs:
        return dict.fromkeys(DEFAULT_OUTPUTS, usual)
    outputs: dict[str, bool] = {}
    for index, output in enumerate(request.outputs):
        name, field = output.name, f"outputs[{index}]"
        if name in outputs:
            raise invalid_request(f"{field}.name", name, "each output once", f"Output `{name}` is requested twice.")
        part = COMPONENT_TENSORS.get(name)
        if (part is None or part.component not in offered_components(model.estimator.name)) and name not in (
            *INLINE_OUTPUTS,
            "covariance",
            *(WRENCH_OUTPUTS if has_wrench(model) else ()),
        ):
            expected = f"an output of estimator {model.estimator.name}: {', '.join(shapes(model))}"
            raise invalid_request(f"{field}.name", name, expected)
        outputs[name] = _binary(output, field, usual)
    return outputs


def _binary(output: schema.InferOutput, field: str, usual: bool) -> bool:
    asked = output.parameters
    if asked is None:
        return usual
    for name, value in (("classification", asked.classification), ("shared_memory_region", asked.shared_memory_region)):
        if value is not None:
            raise invalid_request(f"{field}.parameters.{name}", value, _OTHER_EXTENSION)
    return usual if asked.binary_data is None else asked.binary_data


def _inputs(request: schema.InferRequest, torque: bool) -> tuple[str, ...]:
    """Return the names of the needed inputs; raise InvalidRequestError unless each of them is given exactly once."""
    needed = QUANTITIES if torque else schema.INPUTS
    names = [tensor.name for tensor in request.inputs]
    check_torque(schema.TORQUE in names, torque, f"{FORWARD} or tau_external", "outputs")
    for index, name in enumerate(names):
        if name not in needed:
            raise invalid_request(f"inputs[{index}].name", name, f"one of {', '.join(needed)}")
        if name in names[:index]:
            raise invalid_request(f"inputs[{index}].name", name, "each input once", f"Input `{name}` is given twice.")
    for name in needed:
        if name not in names:
            message = f"Input `{name}` is missing. Required inputs: {', '.join(needed)}."
            raise invalid_request(name, "missing", f"the inputs {', '.join(needed)}", message)
    return needed


def _check_shape(
    tensor: schema.InferInput, shape: list[int], model: TorqueModel, components: bool, may_be_large: bool
) -> None:
    n, field = model.n_joints, f"{tensor.name}.shape"
    if len(shape) not in (1, 2) or shape[-1] != n or shape[0] == 0:
        joints = ", ".join(model.joint_names)
        raise invalid_request(field, shape, f"[{n}] for one query or [N, {n}] for a batch: the joints are {joints}")
    if may_be_large and shape[0] > MAX_BINARY_BATCH and len(shape) == 2:
        raise invalid_request(field, shape, f"at most {MAX_BINARY_BATCH} queries in one request")
    if not may_be_large and len(shape) == 2:
        check_count(field, shape, shape[0], components, " queries")


def _dtype(tensor: schema.InferInput) -> np.dtype[np.floating]:
    """Return the element type of an input; raise InvalidRequestError, also if the tensor is not in the body."""
    name, given = tensor.name, tensor.parameters
    dtype = _DTYPES.get(tensor.datatype)
    if dtype is None:
        raise invalid_request(f"{name}.datatype", tensor.datatype, " or ".join(schema.DATATYPES))
    if given is not None and given.shared_memory_region is not None:
        raise invalid_request(f"{name}.parameters.shared_memory_region", given.shared_memory_region, _OTHER_EXTENSION)
    return dtype


def _as_read(values: NDArray[np.floating], dtype: np.dtype[np.floating]) -> Array:
    """Round values to a datatype and return them as FP64."""
    if dtype == np.float64:
        return values.astype(np.float64, copy=False)
    with np.errstate(over="ignore", invalid="ignore"):  # values out of range become infinite and are rejected later
        return values.astype(dtype).astype(np.float64)


def compute(served: ServedModel, task: InferTask) -> dict[str, Array]:
    """Return the outputs of a task, with first axis N except MODEL_OUTPUTS. Nothing else is computed.

    Raise InvalidRequestError if the inertia matrix cannot be inverted.
    """
    model, scale = served.default_model, served.scales.of(None)
    query, names = task.query, frozenset(task.outputs)
    compared, of_arm = names & EXTERNAL_OUTPUTS.keys(), bool(names & ARM_OUTPUTS.keys())
    needed = {"covariance"} if of_arm else {"tau", "tau_std"} if compared else set()
    tensors = _torques(model, query.values[:3], task.deflections, names | needed)
    if names & MODEL_OUTPUTS:
        tensors |= {"noise_std": model.noise_std, "scale": scale}
    if compared:
        between = tensors["covariance"] if of_arm else None
        seen = external(query.values[3], tensors[MEAN], tensors["tau_std"], model.noise_std, scale, between)
        tensors |= {name: _rows(getattr(seen, EXTERNAL_OUTPUTS[name])) for name in compared}
    tensors |= _wrenches(model, task, scale, names & WRENCH_OUTPUTS.keys())
    parts = {name: COMPONENT_TENSORS[name] for name in names if name in COMPONENT_TENSORS}
    if parts:
        estimates = query.components(model, sorted({part.component for part in parts.values()}), task.deflections)
        for name, part in parts.items():
            estimate = estimates[part.component]
            tensors[name] = _rows(estimate.std if part.std else estimate.mean)
    return tensors


def _wrenches(model: TorqueModel, task: InferTask, scale: Array, names: frozenset[str]) -> dict[str, Array]:
    """Return the named parts of the wrench, (N, 6); raise InvalidRequestError for a singular posture."""
    if not names:
        return {}
    q, dq, ddq, _ = task.query.values
    found = wrenches(model, task.query, Motion(q, dq, ddq, task.deflections).arrays(), scale)
    return {name: np.stack([getattr(each, WRENCH_OUTPUTS[name]) for each in found]) for name in names}


def _rows(values: Array) -> Array:
    """Add a second axis to values of shape (N,)."""
    return values[:, None] if values.ndim == 1 else values


def _torques(model: TorqueModel, motion: Array, deflections: Array | None, names: frozenset[str]) -> dict[str, Array]:
    """Return the named torque tensors; `motion` holds q, dq and ddq, (3, N, n)."""
    wide, rows = "covariance" in names, motion.shape[1]
    names = names & (TORQUE_OUTPUTS | {"covariance"})
    if not names:
        return {}
    if names == {MEAN} and rows > 1:
        return {MEAN: model.torque(motion[0], motion[1], motion[2], deflections)}
    answer: TorqueAnswer | TorquePrediction
    if rows == 1:
        known = motion[:, 0] if deflections is None else np.concatenate([motion[:, 0], deflections[0]])
        answer = model.answer_fully(known, covariance=wide)
    else:
        answer = model.predict(motion[0], motion[1], motion[2], wide, deflections)
    share = np.zeros_like(answer.tau) if answer.fallback is None else answer.fallback.share
    tensors = {"tau": answer.tau, "tau_std": answer.tau_std, "covariance": answer.covariance}
    tensors |= {FALLBACK: share, MEAN: answer.mean}
    return {name: each[None] if rows == 1 else each for name, each in tensors.items() if each is not None}


def infer(
    served: ServedModel,
    decode: Callable[[], Message],
    settings: Settings,
    sequences: Sequences,
    arrived: float,
    timing: Timing,
) -> Reply:
    """Decode a request and answer it. Blocking: use it in a thread.

    Raise what `decode` raises, or InvalidRequestError.
    """
    timing.start()
    message = decode()
    task = read_task(served, message, settings)
    task = follow_sequence(served, message, task, sequences, arrived)
    timing.note_read(task.query.values.shape[1])
    return respond(served, message, task)


def infer_elsewhere(
    storage: Storage, served: ServedModel, body: Buffer, decode: Callable[[Buffer], Message], timing: Timing
) -> tuple[tuple[Any, ...], Timing] | None:
    """Decode a request and answer it; return the fields of the reply, and its times. Raise as `infer` does.

    Return None for a request of a sequence of a model that remembers it.
    """
    timing.start()
    message = decode(body)
    if served.model.remembers and read_part(message.request) is not None:
        return None
    task = read_task(served, message, storage.settings)
    timing.note_read(task.query.values.shape[1])
    return tuple(respond(served, message, task)), timing


def read_task(served: ServedModel, message: Message, settings: Settings) -> InferTask:
    """Check a request against the version of its path and read it; raise InvalidRequestError."""
    request = message.request
    for field, value, expected in (
        ("model_name", request.model_name, served.name),
        ("model_version", request.model_version, str(served.version)),
    ):
        if value not in (None, expected):
            raise invalid_request(field, value, f"{expected}, as in the path")
    return read(message, served.model, settings)


def follow_sequence(
    served: ServedModel, message: Message, task: InferTask, sequences: Sequences, arrived: float
) -> InferTask:
    """Return a task with the deflections of its sequence, which it continues; raise InvalidRequestError.

    arrived: time of the request, of `time.perf_counter`.
    """
    part = read_part(message.request)
    if part is None or not served.model.remembers:
        return task
    return task._replace(deflections=sequences.follow(served, part, arrived, task.query.values[:2]))


def respond(served: ServedModel, message: Message, task: InferTask, timing: Timing | None = None) -> Reply:
    """Compute and encode the answer; raise InvalidRequestError. timing: of an answer that has waited for a thread."""
    if timing is not None:
        timing.start()
    values_of = compute(served, task)
    answers: list[Answer] = []
    for name, binary in task.outputs.items():
        values = values_of[name]
        if task.query.single and name not in MODEL_OUTPUTS:
            values = values[0]
        check_answer(name, values)
        answers.append(Answer(name, values, binary))
    parameters = schema.AnswerParameters(served.revision, served.model.torque_convention)
    return message.encode(Header(served.name, str(served.version), parameters), answers)
