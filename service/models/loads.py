"""What answers where an arm carries something: a model for each stream that does."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from lipcore.model.torque_model import TorqueModel
from service.models.scales import RECENT_S


@dataclass(frozen=True)
class Carried:
    """Of a stream: what answers with its payload, None where it carries nothing; mass: mean and standard deviation, kg;
    received: Unix time of its last batch, s."""

    model: TorqueModel | None
    mass: tuple[float, float] | None
    received: float


class Loads:
    """What a version answers with for each stream; any thread may read while one replaces it.

    One of these belongs to a version for as long as the service runs, as its `Scales` do. asked: what questions that
    belong to no stream are answered with, None where that is the version as it is: the payload that was declared for
    all, or that of the only stream of late. fresh: whether none has been taken yet.
    """

    def __init__(self) -> None:
        self._streams: Mapping[str, Carried] = {}
        self._default: Carried | None = None
        self.asked: TorqueModel | None = None
        self.fresh = True

    def of(self, stream_id: str | None) -> TorqueModel | None:
        """What answers a stream, None for the version as it is; of no stream as of questions."""
        if stream_id is None:
            return self.asked
        known = self._streams.get(stream_id, self._default)
        return None if known is None else known.model

    def mass(self, stream_id: str | None) -> tuple[float, float] | None:
        """Mass that a stream carries, mean and standard deviation, kg; None where it carries nothing."""
        known = self._default if stream_id is None else self._streams.get(stream_id, self._default)
        return None if known is None else known.mass

    def masses(self) -> dict[str, tuple[float, float] | None]:
        """Mass that each stream carries, as `mass` has it, of all streams that are known."""
        return {name: each.mass for name, each in self._streams.items()}

    def take(self, streams: Mapping[str, Carried]) -> None:
        """Answer with these from now on; the default is that of an empty name."""
        self._default = streams.get("")
        known = {name: each for name, each in streams.items() if name}
        latest = max((each.received for each in known.values()), default=0.0)
        recent = [each for each in known.values() if each.received >= latest - RECENT_S]
        default = None if self._default is None else self._default.model
        self.asked = recent[0].model if len(recent) == 1 else default
        self.fresh = False
        self._streams = known
