"""What the control plane publishes to the data plane."""

from __future__ import annotations

from dataclasses import dataclass

from lipcore.data.samples import Array
from lipcore.model.payload import PayloadPosterior
from lipcore.online.transfer import Revision
from service.models.loads import StreamPayload
from service.models.scales import Factor
from service.models.served import Alias, Key


@dataclass(frozen=True)
class Version:
    """A version that the data plane shall have in memory."""

    key: Key
    folder: str
    checksums: dict[str, str]
    scale: Array
    """Width factors from the training, (n,)."""


@dataclass(frozen=True)
class NewRevision:
    """A revision of a version."""

    key: Key
    revision: int
    arrays: Revision


@dataclass(frozen=True)
class Pointers:
    """The versions of all aliases, and the versions that were dropped or deleted."""

    serving: dict[str, int]
    aliases: dict[Alias, int]
    dropped: frozenset[Key]
    deleted: frozenset[Key]


@dataclass(frozen=True)
class StreamState:
    """Width factors and payloads of the streams of a version. None: unchanged."""

    key: Key
    factors: dict[str, Factor] | None
    payloads: dict[str, tuple[PayloadPosterior | None, StreamPayload]] | None
