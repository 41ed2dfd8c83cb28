"""Sequences of requests, as in Triton: the queries of a sequence are one motion, which friction remembers."""

from __future__ import annotations

from collections import OrderedDict
from threading import Lock
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lipcore.kernels.drive.play import PlayState, element_widths
from service.api.oip.schema import SEQUENCE_ID, SEQUENCE_ID_CHARACTERS, InferRequest
from service.foundation.errors import invalid_request
from service.models.loaded import ServedModel

MAX_SEQUENCES = 1000
"""Max sequences in memory. Beyond it, the one that has been silent longest is dropped."""
MAX_SILENCE_S = 60.0
"""Time after which a silent sequence is dropped, s. Its deflections are unknown much earlier, see `MAX_GAP_S`."""

_Key = tuple[str, tuple[str, ...], int | str]


class SequencePart(NamedTuple):
    """The sequence that a request belongs to, and whether the request starts and ends it."""

    id: int | str
    start: bool
    end: bool


def read_part(request: InferRequest) -> SequencePart | None:
    """Return the sequence of a request, None if it belongs to none; raise InvalidRequestError."""
    given = request.parameters
    if given is None:
        return None
    name, start, end = given.sequence_id, bool(given.sequence_start), bool(given.sequence_end)
    if name is None:
        if start or end:
            field = f"parameters.sequence_{'start' if start else 'end'}"
            message = f"`{field}` is true, but `parameters.sequence_id` is missing."
            raise invalid_request("parameters.sequence_id", "missing", SEQUENCE_ID, message)
        return None
    valid = 0 < len(name) <= SEQUENCE_ID_CHARACTERS if isinstance(name, str) else 0 < name < 2**64
    if not valid:
        raise invalid_request("parameters.sequence_id", repr(name) if name == "" else name, SEQUENCE_ID)
    return SequencePart(name, start, end)


class Sequences:
    """The states of all sequences of this process, by model and id; safe to share between threads."""

    def __init__(self) -> None:
        self._states: OrderedDict[_Key, PlayState] = OrderedDict()
        self._lock = Lock()

    def follow(
        self, served: ServedModel, part: SequencePart, arrived: float, motion: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the deflections of the queries of a request, (N, 2 K, n), and keep the state after them.

        arrived: time of the request, s; motion: q and dq, (2, N, n). A sequence that has not been started begins
        unknown. A request that is overtaken by a later one begins unknown, too.
        """
        types = served.model.joint_types
        key, (q, dq), widths = (served.name, types, part.id), motion, element_widths(types)
        with self._lock:
            state = self._states.pop(key, None)
            if state is None or part.start:
                state = PlayState.unknown(len(types))
            deflections, state = state.follow(np.full(len(q), arrived), q, dq, widths)
            if not part.end:
                self._states[key] = state
            self._drop(arrived)
        return deflections

    def _drop(self, now: float) -> None:
        """Drop sequences that are too many, or silent."""
        states = self._states
        while states and (len(states) > MAX_SEQUENCES or now - next(iter(states.values())).packed[0] > MAX_SILENCE_S):
            states.popitem(last=False)
