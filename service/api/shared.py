"""What the processes of one service share: counters, limits of rates, and the motions of sequences."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from service.api.limits.rates import Buckets
from service.api.oip.sequences import Sequences, SharedStates
from service.foundation.settings import Settings
from service.telemetry.counters import CounterMemory, Counters


@dataclass(frozen=True)
class Shared:
    """What a process shares with the other processes of its service. By default it is alone.

    calls: Unix-domain socket at which the control plane gets gRPC calls from the data plane; None: from clients.
    """

    counters: Counters = field(default_factory=Counters)
    buckets: Buckets = field(default_factory=Buckets)
    sequences: Sequences = field(default_factory=Sequences)
    calls: Path | None = None


class SharedMemory:
    """Memory for the parts of a service; create it before its processes are forked.

    calls: see `Shared`.
    """

    def __init__(self, parts: int, settings: Settings, calls: Path) -> None:
        self._counters, self._calls = CounterMemory(parts), calls
        self._buckets, self._states = Buckets(), SharedStates(settings.max_joints)

    def join(self, part: int) -> Shared:
        """Return what the process of a part shares. It continues the counters of an earlier process of this part."""
        return Shared(Counters(self._counters, part), self._buckets, Sequences(self._states), self._calls)
