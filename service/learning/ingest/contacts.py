"""Contacts of one stream: rows far outside the predictive interval, for as long as that can be a contact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.online.gates import Patience


@dataclass(frozen=True)
class ContactGate:
    """Keeps contacts out, or stands back while a changed robot is learnt anew; immutable.

    patience: how long rows have been contacts. calm: how long they have not, while the gate stands back; else None.
    """

    patience: Patience
    calm: Patience | None = None

    @classmethod
    def start(cls, seconds: float) -> ContactGate:
        """A gate that keeps contacts out for so long."""
        return cls(Patience(seconds))

    def to_json(self) -> list[list[Any] | None]:
        """All it knows, as numbers and lists; `from_json` gives back the same gate to the last bit."""
        return [None if each is None else list(astuple(each)[1:]) for each in (self.patience, self.calm)]

    @classmethod
    def from_json(cls, values: Sequence[Sequence[Any] | None], seconds: float) -> ContactGate:
        """The gate that `to_json` wrote, with the patience that is set now, s."""
        patience, calm = (None if each is None else Patience(seconds, *each) for each in values)
        return cls(patience or Patience(seconds), calm)

    @property
    def open(self) -> bool:
        """Whether it stands back: contacts and what has changed cannot be told apart."""
        return self.calm is not None

    @property
    def exhausted(self) -> bool:
        """Whether this has lasted too long for a contact."""
        return self.patience.exhausted

    @property
    def began(self) -> float | None:
        """Event time of the first row of what has lasted so long, s."""
        return None if self.patience.last is None else self.patience.last - self.patience.elapsed

    def step(self, time: Array, contact: NDArray[np.bool_]) -> ContactGate:
        """Follow rows at event times (N,) that are contacts or not; a gate that stood back returns once they fit."""
        if self.calm is None:
            return ContactGate(self.patience.step(time, contact))
        calm = self.calm.step(time, ~contact)
        return ContactGate.start(calm.seconds) if calm.exhausted else ContactGate(self.patience, calm)

    def stand_back(self) -> ContactGate:
        """Let everything pass until most rows fit again for as long as the patience lasts."""
        fresh = Patience(self.patience.seconds)
        return ContactGate(fresh, fresh)
