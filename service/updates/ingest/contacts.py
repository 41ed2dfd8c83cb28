"""Contacts of one stream: rows far outside the predictive interval, for as long as that can be a contact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lipcore.online.gates import Patience
from lipcore.samples import Array


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
