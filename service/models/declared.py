"""What answers for a version with payloads that queries declare."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from lipcore.model.body import Body
from lipcore.model.payload import Carrier
from lipcore.model.torque_model import TorqueModel

Numbers = tuple[float, Sequence[float], Sequence[Sequence[float]] | None]
"""A payload: mass, centre of mass and inertia as `Body` has them, in tuples."""
KEPT = 8
"""Payloads of a version that are kept; a model with one takes about as much memory as the version, but is made in some
milliseconds."""


class Declared:
    """Models with a payload, made of one revision of a version when they are first asked for; the last `KEPT` are kept,
    for as long as the revision is. Safe to share between threads."""

    def __init__(self, model: TorqueModel) -> None:
        self._model = model
        self._kept: dict[Numbers, TorqueModel] = {}
        self._lock, self._making = threading.Lock(), threading.Lock()

    def known(self, payload: Numbers) -> TorqueModel | None:
        """The model with a payload, where it is kept; takes no time."""
        with self._lock:
            model = self._kept.pop(payload, None)
            if model is not None:
                self._kept[payload] = model  # the last that was asked is the last to go
            return model

    def model(self, payload: Numbers) -> TorqueModel:
        """The model with a payload, made where it is not kept. Raise NoArmError where the version knows no rigid
        bodies; ValueError where no body is like that. Not for the event loop."""
        model = self.known(payload)
        if model is not None:
            return model
        with self._making:  # one at a time: who asks for the same waits for the first
            return self.known(payload) or self._made(payload)

    def _made(self, payload: Numbers) -> TorqueModel:
        carrier, (mass, com, inertia) = self.carrier, payload
        body = Body(mass, np.array(com), None if inertia is None else np.array(inertia))
        model = carrier.carrying(carrier.known(body.parameters))
        model.answer(np.zeros((3, model.n_joints)))  # brings its arrays into memory
        with self._lock:
            self._kept[payload] = model
            if len(self._kept) > KEPT:
                del self._kept[next(iter(self._kept))]
        return model

    @cached_property
    def carrier(self) -> Carrier:
        """The revision as what may carry a payload. Raise NoArmError where it knows no rigid bodies."""
        return Carrier(self._model)
