"""Immutable versions in memory, which are read without a lock; and queries that wait for a revision.

The revision may come from an observation batch that another service received.
"""

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
from service.models.declared import DeclaredPayloads
from service.models.loads import StreamPayload, StreamPayloads
from service.models.scales import Factor, Scales

if TYPE_CHECKING:
    from service.foundation.settings import Settings

Key = tuple[str, int]
"""Name of a model and number of a version."""
Alias = tuple[str, str]
"""Name of a model and an alias."""


@dataclass(frozen=True)
class ServedModel:
    """One immutable version in memory. Its answers do not change if the model learns or the version is dropped.

    Only interval widths and payloads change with the streams, through `scales` and `payloads`. All revisions share
    these two.
    """

    name: str
    version: int
    model: TorqueModel
    """The model with all updates up to `revision`."""
    base: TorqueModel
    """The model as trained, without online updates."""
    datasets: frozenset[str]
    """Ids and hashes of the data sets that it has learnt from."""
    scales: Scales
    payloads: StreamPayloads
    revision: int = 0
    """Number of the last online update included; 0 as trained."""

    def has_learnt_from(self, dataset: str, sha256: str) -> bool:
        """Return whether it was trained on a data set, on part of it, or on the same samples uploaded again."""
        return not self.datasets.isdisjoint((dataset, sha256))

    @property
    def default_model(self) -> TorqueModel:
        """The model for queries without a stream, with its payload if there is one."""
        return self.payloads.default_model or self.model

    def model_for(self, stream_id: str | None) -> TorqueModel:
        """Return the model that answers a stream."""
        return self.payloads.model_for(stream_id) or self.model

    @cached_property
    def carrier(self) -> Carrier | None:
        """The carrier that adds payloads to the model; None if the model has no arm, or several."""
        return self.declared_payloads.carrier if self.model.arms == 1 else None

    @cached_property
    def declared_payloads(self) -> DeclaredPayloads:
        """Models for queries that declare their own payload."""
        return DeclaredPayloads(self.model)

    @cached_property
    def noise_std(self) -> list[float]:
        """Standard deviation of the measurement noise in answers, (n,) N·m."""
        numbers: list[float] = self.model.noise_std.tolist()
        return numbers

    @cached_property
    def guaranteed(self) -> list[float] | None:
        """Guaranteed coverage of the intervals, (n,), from held-out blocks of the training; None: no guarantee."""
        return None if self.base.conformal is None else list(self.base.conformal.guaranteed)


@dataclass(frozen=True)
class LearntState:
    """What a version has learnt since its training: `model` at `revision`.

    If `behind`, the log contains more than that.
    """

    model: TorqueModel
    revision: int
    behind: bool


class LearntStates(Protocol):
    """Source of what versions have learnt online. Methods return None or an empty result if a version learnt nothing.

    `base` is the version as trained.
    """

    def find(self, model: str, version: int, base: TorqueModel) -> LearntState | None:
        """Return the newest state that is available without computing."""

    def payloads(self, model: str, version: int, carrier: Carrier) -> Mapping[str, StreamPayload]:
        """Return the payload model of each stream."""

    def factors(self, model: str, version: int) -> Mapping[str, Factor]:
        """Return the width factors of each stream."""

    def consolidated(self, model: str, version: int, base: TorqueModel) -> LearntState | None:
        """Return the complete state as a model that can be saved.

        This learns the log since the last snapshot, which takes time.
        """


class RevisionWaiter:
    """A coroutine that waits until a model's answers change."""

    def __init__(self) -> None:
        self._loop, self._changed = asyncio.get_running_loop(), asyncio.Event()

    def wake(self) -> None:
        """Report a change; from any thread."""
        with suppress(RuntimeError):  # the event loop is closed: no coroutine waits
            self._loop.call_soon_threadsafe(self._changed.set)

    async def wait(self, seconds: float) -> None:
        """Wait for the next change, at most `seconds`."""
        with suppress(TimeoutError):
            await asyncio.wait_for(self._changed.wait(), seconds)
        self._changed.clear()


class RevisionWaiters:
    """Waiting coroutines by model; safe to share between threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiters: dict[str, set[RevisionWaiter]] = {}

    def wake(self, model: str) -> None:
        """Wake the coroutines that wait for a model; never waits itself."""
        with self._lock:
            waiters = tuple(self._waiters.get(model, ()))
        for waiter in waiters:
            waiter.wake()

    @contextmanager
    def waiter(self, model: str) -> Iterator[RevisionWaiter]:
        """Register a waiter for a model; for the event loop. It misses no change from here on."""
        made = RevisionWaiter()
        with self._lock:
            self._waiters.setdefault(model, set()).add(made)
        try:
            yield made
        finally:
            with self._lock:
                self._waiters[model].discard(made)
                if not self._waiters[model]:
                    del self._waiters[model]


class AnsweringModels(Protocol):
    """The versions in memory, as queries and streams need them: `LoadedModels`, and its copy in another process."""

    waiters: RevisionWaiters

    @property
    def settings(self) -> Settings:
        """The settings of the service."""
        ...

    def hot(self, model: str, version: int | None, alias: str | None = None) -> ServedModel | None:
        """Return a version if it is in memory; never waits."""
        ...

    def get(self, model: str, version: int | None, alias: str | None = None) -> ServedModel:
        """Return a version, after loading it if needed. Blocking; raise ServiceError."""
        ...

    def newest(self, model: str, alias: str | None = None) -> int | None:
        """Return the number of the version of an alias, or of the serving version."""
        ...

    def is_deleted(self, model: str, version: int) -> bool:
        """Return whether a version was deleted."""
        ...

    def wake(self, model: str) -> None:
        """Let the learner look for batches of a model that another service has logged."""
        ...


async def wait_for_revision(
    loaded: AnsweringModels, model: str, version: int | None, alias: str | None, revision: int
) -> ServedModel:
    """Wait until a version has reached a revision and return it. Use it in the event loop; it does not block.

    Raise RevisionNotReachedError after `min_revision_wait_s`, NotFoundError or UnreadableVersionError at once.
    """
    loop = asyncio.get_running_loop()
    until, asked = loop.time() + loaded.settings.min_revision_wait_s, False
    with loaded.waiters.waiter(model) as waiter:
        while True:
            served = loaded.hot(model, version, alias)
            if served is None:
                served = await to_thread.run_sync(loaded.get, model, version, alias)
            if served.revision >= revision:
                return served
            if not asked:  # the service that logged the batch may not have woken the learner yet
                loaded.wake(model)
                asked = True
            left = until - loop.time()
            if left <= 0:
                raise _not_reached(served, revision)
            await waiter.wait(left)


def _not_reached(served: ServedModel, revision: int) -> RevisionNotReachedError:
    name = f"version {served.version} of model {served.name!r}"
    text = f"{name} is at revision {served.revision} and has not reached revision {revision} yet: retry"
    expected = f"at most {served.revision} at present, of version {served.version}"
    return RevisionNotReachedError(text, [problem("min_revision", revision, expected)], {"Retry-After": "1"})
