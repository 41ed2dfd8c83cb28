"""A recording thinned for a plot."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from service.client.call import Answer
from service.client.results.arrays import Array, Plain, array


@dataclass(frozen=True, eq=False)
class PreviewColumn(Plain):
    """Points (K) of one quantity of one joint: rows, counted from 0; t: their times, s; values in `unit`."""

    quantity: str
    joint: str
    unit: str
    rows: NDArray[np.int64]
    t: Array
    values: Array


@dataclass(frozen=True, eq=False)
class Preview(Plain):
    """Columns of a data set, thinned so that no extreme is lost. samples: rows of the data set; starts: first rows of
    its episodes."""

    samples: int
    starts: NDArray[np.int64]
    columns: tuple[PreviewColumn, ...]

    def column(self, quantity: str, joint: str) -> PreviewColumn:
        """One column; raise KeyError."""
        for each in self.columns:
            if (each.quantity, each.joint) == (quantity, joint):
                return each
        raise KeyError(f"no column of {quantity} of {joint}")


def read_preview(answer: Answer) -> Preview:
    """Read the answer to `preview`."""
    said = msgspec.json.decode(answer.body)
    columns = tuple(
        PreviewColumn(
            each["quantity"],
            each["joint"],
            each["unit"],
            np.array(each["rows"], np.int64),
            array(each["t"]),
            array(each["values"]),
        )
        for each in said["columns"]
    )
    return Preview(said["samples"], np.array(said["starts"], np.int64), columns)
