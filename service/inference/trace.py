"""Following a model along a data set: measured and predicted torque row by row."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from lipcore.data.motion import Motion
from lipcore.data.samples import Array, Samples
from lipcore.model import dynamics
from service.foundation.errors import invalid_request
from service.inference import evaluating
from service.inference.comparison_schema import TraceComponent, TraceComponentValues, TraceRequest, TraceResponse
from service.models.loaded import LoadedModels
from service.models.served import Served
from service.storage import sample_file
from service.training.holding_out import CannotHoldOutError

Rows = NDArray[np.int64]


def trace(loaded: LoadedModels, model: str, request: TraceRequest) -> TraceResponse:
    """Follow a model along a data set or what it has held out of it.

    Raise InvalidRequestError, NotFoundError or DamagedDataError. Not for the event loop.
    """
    most = loaded.storage.settings.max_trace_points
    if request.points > most:
        raise invalid_request("points", request.points, f"at most {most}")
    served = loaded.get(model, request.version, request.alias)
    offered = dynamics.available(served.model.estimator)
    _check(served, request.components, offered)
    dataset = evaluating.fitting(loaded, request.dataset, served)
    path = loaded.files.samples_file(dataset.id, dataset.sha256)
    episode, t = (sample_file.read_array(path, name) for name in ("episode", "t"))
    part = np.arange(len(t), dtype=np.int64)
    if request.part == "held_out":
        try:
            part = np.flatnonzero(evaluating.split_of(loaded, dataset, served).held_out(episode, t)).astype(np.int64)
        except CannotHoldOutError as error:
            raise evaluating.not_held_out(str(error)) from None
    chosen = _within(part, request, len(t))
    rows = chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), request.points)).round().astype(np.int64)]
    samples = Samples(served.model.joint_names, **sample_file.read(path, rows))
    predicted = served.model.predict(samples.q, samples.dq, samples.ddq)
    return TraceResponse(
        model=served.name,
        version=served.version,
        revision=served.revision,
        dataset=dataset.id,
        part=request.part,
        joint_names=list(served.model.joint_names),
        torque_convention=served.model.torque_convention,
        samples=len(part),
        in_range=len(chosen),
        shown=len(rows),
        rows=rows.tolist(),
        t=samples.t.tolist(),
        breaks=_breaks(part, episode, rows),
        tau=samples.tau.tolist(),
        mean=predicted.tau.tolist(),
        std=predicted.tau_std.tolist(),
        noise_std=predicted.noise_std.tolist(),
        offered=[name for name in get_args(TraceComponent) if name in offered],
        components=_components(served, samples, request.components, loaded.storage.settings.max_component_batch),
        in_training=request.part == "all" and served.has_learnt_from(dataset.id, dataset.sha256),
    )


def _check(served: Served, names: Sequence[TraceComponent], offered: Collection[str]) -> None:
    """Raise InvalidRequestError for a component that the model's estimator does not offer."""
    for index, name in enumerate(names):
        if name not in offered:
            expected = f"what a model with the estimator {served.model.estimator.name} offers: {', '.join(offered)}"
            raise invalid_request(f"components[{index}]", name, expected)


def _within(part: Rows, request: TraceRequest, count: int) -> Rows:
    """Rows of a part from `start` to `stop`; raise InvalidRequestError where there are none."""
    if request.start >= count:
        raise invalid_request("start", request.start, f"a row of the data set, 0 to {count - 1}")
    if request.stop is not None and request.stop <= request.start:
        raise invalid_request("stop", request.stop, f"a row after start, {request.start}")
    stop = count if request.stop is None else request.stop
    chosen = part[(part >= request.start) & (part < stop)]
    if not len(chosen):
        expected = f"rows of which some were held out; these lie between {part[0]} and {part[-1]}"
        raise invalid_request("start", f"{request.start}, up to {stop}", expected)
    return chosen


def _breaks(part: Rows, episode: NDArray[np.int64], rows: Rows) -> list[int]:
    """Places in `rows` before which the part is interrupted or the episode changes."""
    anew = (np.diff(part) != 1) | (np.diff(episode[part]) != 0)
    piece = np.concatenate([[0], np.cumsum(anew)])[np.searchsorted(part, rows)]
    return (np.flatnonzero(np.diff(piece)) + 1).tolist()


def _components(
    served: Served, samples: Samples, names: Sequence[TraceComponent], batch: int
) -> dict[TraceComponent, TraceComponentValues]:
    """Parts of the torque at samples, so many at a time: they take far more memory than a torque."""
    if not names:
        return {}
    mean: dict[TraceComponent, list[Array]] = {name: [] for name in names}
    std: dict[TraceComponent, list[Array]] = {name: [] for name in names}
    for first in range(0, len(samples), batch):
        some = samples.rows(slice(first, first + batch))
        estimates = dynamics.components(served.model, Motion.from_arrays(some.q, some.dq, some.ddq), names)
        for name in names:
            mean[name].append(estimates[name].mean.numpy())
            std[name].append(estimates[name].std.numpy())
    return {
        name: TraceComponentValues(mean=np.concatenate(mean[name]).tolist(), std=np.concatenate(std[name]).tolist())
        for name in names
    }
