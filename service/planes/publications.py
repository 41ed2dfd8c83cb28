"""What the control plane publishes to the data planes, and what they reply."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from lipcore.model.torque_model import TorqueModel
from lipcore.online.transfer import Revision
from service.api.access.keys import KeyRecord
from service.models.registry import Serving
from service.models.scales import Factor
from service.models.served import Alias, Key


@dataclass(frozen=True)
class NewVersion:
    """A version that the data plane shall have in memory."""

    key: Key
    base: TorqueModel
    """The version as trained, with its evaluator."""


@dataclass(frozen=True)
class NewRevision:
    """A revision of a version."""

    key: Key
    revision: int
    arrays: Revision


@dataclass(frozen=True)
class NewPayload:
    """A version with a payload that streams have. Streams name it by its number."""

    key: Key
    number: int
    model: TorqueModel


@dataclass(frozen=True)
class PayloadState:
    """The payload of a stream; see `StreamPayload`."""

    number: int | None
    """Number of the model; None if the stream has no payload."""
    mass: tuple[float, float] | None
    received: float


@dataclass(frozen=True)
class StreamStates:
    """Width factors and payloads of a version's streams: those that changed, and the streams that are gone.

    complete: these are all streams.
    """

    key: Key
    factors: Mapping[str, Factor]
    payloads: Mapping[str, PayloadState]
    without_factors: Collection[str] = ()
    without_payloads: Collection[str] = ()
    complete: bool = False


@dataclass(frozen=True)
class Pointers:
    """The serving versions of loaded models, all other aliases, and the versions that are gone."""

    serving: Mapping[str, Serving]
    aliases: Mapping[Alias, int]
    deleted: frozenset[Key]
    """Versions that were deleted since the last message."""
    kept: frozenset[Key] | None
    """Versions in memory: the data plane drops all others. None until the control plane has loaded what it needs."""


@dataclass(frozen=True)
class KeysRead:
    """All API keys."""

    keys: tuple[KeyRecord, ...]


@dataclass(frozen=True)
class Published:
    """End of a publication: the data plane confirms its number."""

    number: int


@dataclass(frozen=True)
class Holdings:
    """First message of a data plane: the versions in its memory with their revisions, and whether it answers."""

    revisions: Mapping[Key, int]
    answers: bool


@dataclass(frozen=True)
class Answering:
    """The data plane answers from now on."""


@dataclass(frozen=True)
class Confirmed:
    """The data plane answers with all that was published up to this number."""

    number: int


@dataclass(frozen=True)
class LoadRequest:
    """The data plane needs a version; see `LoadedModels.get`."""

    model: str
    version: int | None
    alias: str | None


@dataclass(frozen=True)
class NotLoaded:
    """A version that was requested cannot be loaded."""

    request: LoadRequest


@dataclass(frozen=True)
class LearnerWake:
    """Asks the control plane to look for batches of a model that another service has logged."""

    model: str


@dataclass(frozen=True)
class VersionUse:
    """The versions that the data plane has used since its last report, and those that only its streams keep."""

    used: tuple[Key, ...]
    streamed: frozenset[Key]
    confirmed: int
    """Number of the last publication that the data plane had applied."""
