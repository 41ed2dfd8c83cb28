"""Pass of a job over all of its rows: condition the posterior on every row, shard by shard.

A shard's worker receives plain data, so it may be a process on another host. It opens the data set's file itself and
rebuilds the basis from the stored model. Both are kept for later shards.
"""

from __future__ import annotations

import hashlib
import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np

from lipcore.data import independence
from lipcore.data.samples import Array, Samples
from lipcore.estimators.options import FitOptions
from lipcore.files import persistence
from lipcore.model.torque_model import TorqueModel
from lipcore.posterior.statistics import empty
from lipcore.posterior.summing import Summing
from lipcore.training.conditioning import ShardStatistics, sum_samples, with_statistics
from lipcore.vocabulary import Device, JointType
from service.foundation.settings import Settings
from service.runtime.executors import choose_settings, settings_to_send, shard_executor, sum_shards
from service.storage.files import PATIENCE_S, Files
from service.storage.sample_file import Reader, follow
from service.training.table import Shard, Table

Made = TypeVar("Made")


@dataclass(frozen=True)
class Context:
    """Data that all shards of a pass share."""

    settings: Settings | None
    """Settings; None for a worker that has its own."""
    model: dict[str, bytes]
    """Packed files of the model."""
    joint_names: tuple[str, ...]
    joint_types: tuple[JointType, ...] | None
    """Types of the joints, if friction remembers motion, else None."""
    device: Device
    """Device to compute on."""


def all_rows(
    settings: Settings,
    model: TorqueModel,
    table: Table,
    logged: tuple[Samples, Array] | None,
    options: FitOptions,
    cancelled: Callable[[], bool],
    progress: Callable[[float], None],
) -> TorqueModel:
    """Return the model with the posterior of all rows of a table and a log, not only those that its fit selected.

    `table` and `logged` contain rows with weights. `progress` is called with the finished share. Raise
    FitCancelledError if `cancelled` returns True.
    """
    gpu = options.device == "cuda"
    rows = len(table) + (0 if logged is None else len(logged[0]))
    total: ShardStatistics | None = None
    shards = table.shards()
    if shards:
        progress(0.0)
        context = Context(
            settings_to_send(settings),
            packed(model),
            model.joint_names,
            model.joint_types if model.remembers else None,
            "cuda" if gpu else "cpu",
        )
        with shard_executor(settings, gpu) as executor:
            work = partial(shard_statistics, context)
            share = len(table) / rows / len(shards)
            total = sum_shards(executor, work, shards, cancelled, done=lambda done: progress(share * done))
    if logged is not None:
        of_log = sum_samples(Summing.of(model.posterior), *logged, cancelled)
        total = of_log if total is None else total + of_log
    assert total is not None  # a job has samples
    return with_statistics(model, total, rows)


def shard_statistics(context: Context, shard: Shard) -> ShardStatistics:
    """Return the statistics of one shard's rows; runs in a worker."""
    name = hashlib.sha256(b"".join(context.model.values())).hexdigest() + context.device
    summing = _cached(_SUMMING, name, 2, lambda: _summing(context))
    samples, weights = read(choose_settings(context.settings), context.joint_names, context.joint_types, shard)
    return sum_samples(summing, samples, weights)


def read(
    settings: Settings, joint_names: tuple[str, ...], joint_types: tuple[JointType, ...] | None, shard: Shard
) -> tuple[Samples, Array]:
    """Return the selected rows of a shard and their weights, (N,)."""

    def opened() -> Reader:
        return Reader(Files.of(settings, PATIENCE_S).samples_file(shard.dataset, shard.sha256))

    reader = _cached(_READERS, shard.sha256 + shard.dataset, 8, opened)
    # one more row at both ends, so that weights equal those of the whole recording
    first, last = max(0, shard.first - 1), min(reader.rows, shard.last + 1)
    rows, mask = slice(shard.first - first, shard.last - first), shard.mask()
    values = {name: reader.array(name, first, last) for name in ("t", "episode")}
    weights = np.full(shard.last - shard.first, shard.factor)
    if shard.timed:
        weights *= independence.recording_weights(values["t"], values["episode"])[rows]
    values = {name: each[rows] for name, each in values.items()}
    values |= {name: reader.array(name, shard.first, shard.last) for name in ("q", "dq", "ddq", "tau")}
    index = np.arange(shard.first, shard.last)
    deflections = None if joint_types is None else follow(reader, index, joint_types)
    samples = Samples(joint_names=joint_names, deflections=deflections, **values)
    return (samples, weights) if mask is None else (samples.rows(mask), weights[mask])


def packed(model: TorqueModel) -> dict[str, bytes]:
    """Return the compressed files of a model without its statistics, about 0.1 MB: basis and noise are enough."""
    posterior = replace(model.posterior, statistics=empty(len(model.posterior.basis)))
    _, files = persistence.encode(replace(model, posterior=posterior))
    return {name: zlib.compress(each) for name, each in files.items()}


def _summing(context: Context) -> Summing:
    files = {name: zlib.decompress(each) for name, each in context.model.items()}
    return Summing.of(persistence.decode(files).posterior, context.device)


_SUMMING: OrderedDict[str, Summing] = OrderedDict()
_READERS: OrderedDict[str, Reader] = OrderedDict()
_lock = threading.Lock()
"""Needed as a worker of a cluster has several threads."""


def _cached(kept: OrderedDict[str, Made], key: str, most: int, make: Callable[[], Made]) -> Made:
    """Return the value of a key, made if missing; the `most` last used are kept."""
    with _lock:
        if key not in kept:
            kept[key] = make()
        kept.move_to_end(key)
        while len(kept) > most:
            kept.popitem(last=False)
        return kept[key]
