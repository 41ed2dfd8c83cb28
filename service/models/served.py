"""Versions in memory as they answer: immutable, so that whoever holds one needs no lock; and queries that wait for what
they have taught, whichever service has taken the batch."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

from anyio import to_thread

from lipcore.model.payload import Carrier
from lipcore.model.torque_model import TorqueModel
from service.foundation.errors import RevisionNotReachedError, problem
from service.models.declared import Declared
from service.models.loads import Carried, Loads
from service.models.scales import Factor, Scales

if TYPE_CHECKING:
    from service.models.loaded import LoadedModels

Key = tuple[str, int]
"""A model and the number of a version."""
Alias = tuple[str, str]
"""A model and an alias."""


@dataclass(frozen=True)
class Served:
    """One version in memory, immutable: whoever holds it answers from it whatever is learnt or dropped meanwhile. Only
    the widths of its intervals and what its arm carries follow its streams at once: `scales` and `loads`, the same for
    all revisions.

    model: what answers; base: the version as trained; datasets: ids and hashes of the data sets it has learnt
    from; revision: online updates applied to it.
    """

    name: str
    version: int
    model: TorqueModel
    base: TorqueModel
    datasets: frozenset[str]
    scales: Scales
    loads: Loads
    revision: int = 0

    def has_learnt_from(self, dataset: str, sha256: str) -> bool:
        """Whether it was trained on a data set or part of it, or on the same samples uploaded another time."""
        return not self.datasets.isdisjoint((dataset, sha256))

    @property
    def asked(self) -> TorqueModel:
        """What answers questions that belong to no stream: with what its arm carries, where that is something."""
        return self.loads.asked or self.model

    def answering(self, stream_id: str | None) -> TorqueModel:
        """What answers a stream."""
        return self.loads.of(stream_id) or self.model

    @cached_property
    def carrier(self) -> Carrier | None:
        """The model as what may carry a payload; None where it knows no arm."""
        return None if self.model.arm is None else self.declared.carrier

    @cached_property
    def declared(self) -> Declared:
        """What answers with payloads that queries declare, instead of what its streams carry."""
        return Declared(self.model)

    @cached_property
    def noise_std(self) -> list[float]:
        """Standard deviation of the measured torque around the function, (n,) N·m, as answers carry it."""
        numbers: list[float] = self.model.noise_std.tolist()
        return numbers

    @cached_property
    def guaranteed(self) -> list[float] | None:
        """Share of measurements that left-out blocks of the training guarantee for its intervals, (n,)."""
        return None if self.base.conformal is None else list(self.base.conformal.guaranteed)


@dataclass(frozen=True)
class Learnt:
    """A version as trained and what it has learnt since: the model at a revision. behind: whether the log holds more
    than that."""

    model: TorqueModel
    revision: int
    behind: bool


class LearntStates(Protocol):
    """Knows what versions have learnt; each answer is None where that is nothing. base: the version as trained."""

    def find(self, model: str, version: int, base: TorqueModel) -> Learnt | None:
        """As much of it as takes no time."""

    def carried(self, model: str, version: int, carrier: Carrier) -> Mapping[str, Carried]:
        """What answers for its streams, with what they carry."""

    def factors(self, model: str, version: int) -> Mapping[str, Factor]:
        """What its streams have made of the widths of its intervals, by stream."""

    def consolidated(self, model: str, version: int, base: TorqueModel) -> Learnt | None:
        """All of it, as a model that can be saved: it takes the time to learn what came since the last snapshot."""


class Waiter:
    """A coroutine that waits for a model to answer otherwise than before."""

    def __init__(self) -> None:
        self._loop, self._changed = asyncio.get_running_loop(), asyncio.Event()

    def wake(self) -> None:
        """Say that the model answers otherwise; from any thread."""
        with suppress(RuntimeError):  # the loop has ended, and nobody waits any more
            self._loop.call_soon_threadsafe(self._changed.set)

    async def wait(self, seconds: float) -> None:
        """Wait until it does since the last time, or so long."""
        with suppress(TimeoutError):
            await asyncio.wait_for(self._changed.wait(), seconds)
        self._changed.clear()


class Waiting:
    """Who waits for which model; safe to share between threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiters: dict[str, set[Waiter]] = {}

    def wake(self, model: str) -> None:
        """Wake those that wait for a model; never waits itself."""
        with self._lock:
            waiters = tuple(self._waiters.get(model, ()))
        for waiter in waiters:
            waiter.wake()

    @contextmanager
    def waiter(self, model: str) -> Iterator[Waiter]:
        """Wait for a model; for the event loop. What happens from here on is not missed."""
        made = Waiter()
        with self._lock:
            self._waiters.setdefault(model, set()).add(made)
        try:
            yield made
        finally:
            with self._lock:
                self._waiters[model].discard(made)
                if not self._waiters[model]:
                    del self._waiters[model]


async def reached(loaded: LoadedModels, model: str, version: int | None, alias: str | None, revision: int) -> Served:
    """Return the version that answers once it has a revision, or a later one. For the event loop, which goes on. Raise
    RevisionNotReachedError after `min_revision_wait_s`; NotFoundError or UnreadableVersionError at once."""
    loop = asyncio.get_running_loop()
    until, asked = loop.time() + loaded.storage.settings.min_revision_wait_s, False
    with loaded.waiting.waiter(model) as waiter:
        while True:
            served = loaded.hot(model, version, alias)
            if served is None:
                served = await to_thread.run_sync(loaded.get, model, version, alias)
            if served.revision >= revision:
                return served
            if not asked:  # whoever has logged what is missing may have told nobody yet
                loaded.wake(model)
                asked = True
            left = until - loop.time()
            if left <= 0:
                raise _not_reached(served, revision)
            await waiter.wait(left)


def _not_reached(served: Served, revision: int) -> RevisionNotReachedError:
    name = f"version {served.version} of model {served.name!r}"
    text = f"{name} answers with revision {served.revision} and has not learnt up to revision {revision} yet: ask again"
    expected = f"{served.revision} or less now, of version {served.version}"
    return RevisionNotReachedError(text, [problem("min_revision", revision, expected)], {"Retry-After": "1"})
