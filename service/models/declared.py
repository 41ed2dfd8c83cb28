"""Models of a version with the payloads that queries declare."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from lipcore.model.body import Body
from lipcore.model.payload import Carrier
from lipcore.model.torque_model import TorqueModel

Numbers = tuple[float, Sequence[float], Sequence[Sequence[float]] | None]
"""A payload: mass, centre of mass and inertia as in `Body`, as tuples."""
MAX_KEPT_MODELS = 8
"""Maximum models with a payload kept for a version. Each needs about as much memory as the version; making one takes a
few milliseconds.
"""


class DeclaredPayloads:
    """Models with a payload, made on first use from one revision of a version.

    The last `MAX_KEPT_MODELS` are kept as long as the revision. Safe to share between threads.
    """

    def __init__(self, model: TorqueModel) -> None:
        self._model = model
        self._kept: dict[Numbers, TorqueModel] = {}
        self._lock, self._making = threading.Lock(), threading.Lock()

    def cached(self, payload: Numbers) -> TorqueModel | None:
        """Return the model with a payload if it is kept, else None; never waits."""
        with self._lock:
            model = self._kept.pop(payload, None)
            if model is not None:
                self._kept[payload] = model  # moves to the end: the least recently used is dropped first
            return model

    def model(self, payload: Numbers) -> TorqueModel:
        """Return the model with a payload; make it if it is not kept. Blocking: use it in a thread.

        Raise NoArmError if the version has no rigid bodies, ValueError if the payload is not a possible body.
        """
        model = self.cached(payload)
        if model is not None:
            return model
        with self._making:  # one at a time: two requests for one payload make one model
            return self.cached(payload) or self._made(payload)

    def _made(self, payload: Numbers) -> TorqueModel:
        carrier, (mass, com, inertia) = self.carrier, payload
        body = Body(mass, np.array(com), None if inertia is None else np.array(inertia))
        model = carrier.with_payload(carrier.known(body.parameters))
        model.answer(np.zeros((3, model.n_joints)))  # loads its arrays into memory
        with self._lock:
            if len(self._kept) >= MAX_KEPT_MODELS:
                del self._kept[next(iter(self._kept))]
            self._kept[payload] = model
        return model

    @cached_property
    def carrier(self) -> Carrier:
        """Return the carrier of this revision; raise NoArmError if it has no rigid bodies."""
        return Carrier(self._model)
