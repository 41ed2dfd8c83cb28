"""Measured torque beside a model's, row by row."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from service.client.call import Answer
from service.client.results.arrays import Array, Plain, array
from service.client.results.prediction import Component, interval


@dataclass(frozen=True, eq=False)
class Trace(Plain):
    """Torques (K, n) at K rows of a data set, N·m (prismatic: N).

    samples: of the data set or the part; in_range: of these between start and stop; shown: K, evenly chosen where there
    are more, so that peaks may be missing; rows: (K) counted from 0; t: (K) s; breaks: places in `rows` that lines are
    not to be drawn across; tau: measured; mean: predicted; std: (K, n) of the function; noise_std: (n) of a
    measurement; offered: components that may be asked for; components: by name, where asked for; in_training: whether
    the model was trained on these samples: then it looks better than it is.
    """

    model: str
    version: int
    revision: int
    dataset: str
    part: str
    joint_names: tuple[str, ...]
    torque_convention: str
    samples: int
    in_range: int
    shown: int
    rows: NDArray[np.int64]
    t: Array
    breaks: NDArray[np.int64]
    tau: Array
    mean: Array
    std: Array
    noise_std: Array
    offered: tuple[str, ...]
    components: Mapping[str, Component]
    in_training: bool

    def interval(self, level: float = 0.95) -> tuple[Array, Array]:
        """Lower and upper end (K, n) of the interval that shall hold a share `level` of the *measurements*."""
        return interval(self.mean, self.std, self.noise_std, level)


_ARRAYS = ("t", "tau", "mean", "std", "noise_std")


def read_trace(answer: Answer) -> Trace:
    """Read the answer to `trace`."""
    said: dict[str, Any] = msgspec.json.decode(answer.body)
    shape = (len(said["rows"]), len(said["joint_names"]))  # also where there are no rows
    numbers = {name: array(said[name]) for name in _ARRAYS}
    return Trace(
        **{name: value for name, value in said.items() if name in _NAMED},
        joint_names=tuple(said["joint_names"]),
        rows=np.array(said["rows"], np.int64),
        breaks=np.array(said["breaks"], np.int64),
        t=numbers["t"],
        tau=numbers["tau"].reshape(shape),
        mean=numbers["mean"].reshape(shape),
        std=numbers["std"].reshape(shape),
        noise_std=numbers["noise_std"],
        offered=tuple(said["offered"]),
        components={
            name: Component(array(each["mean"]).reshape(shape), array(each["std"]).reshape(shape))
            for name, each in said["components"].items()
        },
    )


_NAMED = frozenset(
    ("model", "version", "revision", "dataset", "part", "torque_convention", "samples", "in_range", "shown")
) | {"in_training"}
