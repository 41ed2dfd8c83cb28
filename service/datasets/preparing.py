"""From staged columns to staged samples: what is missing is derived, one joint at a time, and every step is said."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lipcore.data.samples import Array
from lipcore.preparation.errors import PreparationError
from lipcore.preparation.plan import Plan, plan
from lipcore.preparation.recipe import Recipe
from service.datasets.staging import EPISODE, TIME, Staged, column
from service.foundation.errors import invalid_data
from service.storage.disk import Disk

FOLDER = "prepared"
"""Of prepared columns: those that were read have the same names."""


@dataclass(frozen=True)
class Facts:
    """What preparing a recording found and did, for its report.

    rows: of the recording; samples: that came out; episodes: contiguous parts of these; recorded_rate_hz: one over the
    usual step of time, None without times; rate_hz: of the samples; gaps: places in time where the recording was split;
    missing: rows left out for missing values; first_missing: the first of them, counted from 1; repeated: rows left out
    as their time stamp was there before; derived: of "dq" and "ddq", those derived; resampled: onto an even clock;
    cutoff_hz: of the low-pass, None where none was used; delay_s: by which samples are late of a live stream, 0 for
    the acausal form; edges: samples cut off at the ends of parts, parts too short to filter included.
    """

    rows: int
    samples: int
    episodes: int
    recorded_rate_hz: float | None
    rate_hz: float | None
    gaps: int = 0
    missing: int = 0
    first_missing: int | None = None
    repeated: int = 0
    derived: tuple[str, ...] = ()
    resampled: bool = False
    cutoff_hz: float | None = None
    delay_s: float = 0.0
    edges: int = 0


@dataclass(frozen=True)
class Prepared:
    """Samples ready to learn from, and how they came about.

    staged: `t`, `episode` and all of q, dq, ddq, tau, finite, (M,) each; steps: what was done, in order, each a JSON
    object with `step`, its parameters and `text`, a sentence; facts: figures of it.
    """

    staged: Staged
    steps: list[dict[str, Any]]
    facts: Facts


def prepare(raw: Staged, folder: Path, recipe: Recipe, min_samples: int, disk: Disk | None = None) -> Prepared:
    """Prepare staged columns, NaN where a value is missing, in a folder of their own below `folder`.

    A few columns are in memory at a time. Raise InvalidDataError where the recording does not allow what the recipe
    asks for, or where fewer than min_samples come out; StorageFullError.
    """
    try:
        made = plan(_or_none(raw, TIME), _or_none(raw, EPISODE), raw.missing(), raw.quantities, recipe)
    except PreparationError as error:
        raise invalid_data(error.field, error.value, error.expected) from None
    if len(made) < min_samples:
        why = "trimming the filter's edges" if made.cutoff is not None else "leaving out what cannot be used"
        raise invalid_data("rows", len(made), f"at least {min_samples} samples after {why}")
    own = folder / FOLDER
    own.mkdir()
    staged = Staged(own, raw.joint_names, raw.disk if disk is None else disk)
    staged.append({TIME: made.t, EPISODE: made.episode.astype(np.float64)})
    for joint in range(raw.n_joints):
        for name, values in made.columns(_Joint(raw, joint)):
            staged.append({column(name, joint): values})
    return Prepared(staged, made.steps, _facts(raw.rows, made))


class _Joint(Mapping[str, Array]):
    """Columns of one joint by quantity, each read when it is asked for."""

    def __init__(self, raw: Staged, joint: int) -> None:
        self.raw, self.joint = raw, joint

    def __getitem__(self, name: str) -> Array:
        return self.raw.read(column(name, self.joint))

    def __iter__(self) -> Iterator[str]:
        return iter(self.raw.quantities)

    def __len__(self) -> int:
        return len(self.raw.quantities)


def _or_none(raw: Staged, name: str) -> Array | None:
    return raw.read(name) if name in raw else None


def _facts(rows: int, made: Plan) -> Facts:
    return Facts(
        rows=rows,
        samples=len(made),
        episodes=made.episodes,
        recorded_rate_hz=made.recorded_rate,
        rate_hz=made.rate,
        gaps=made.gaps,
        missing=made.missing,
        first_missing=made.first_missing,
        repeated=made.repeated,
        derived=made.derived,
        resampled=made.resampled,
        cutoff_hz=made.cutoff,
        delay_s=made.delay_s,
        edges=made.edges,
    )
