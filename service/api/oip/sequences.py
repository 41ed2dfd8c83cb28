"""Sequences of requests, as in Triton: the queries of a sequence are one motion, which friction remembers."""

from __future__ import annotations

import mmap
from collections import OrderedDict
from threading import Lock
from typing import NamedTuple, Protocol

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

PLACES = 8
"""Number of places that a shared state may be at."""

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


class States(Protocol):
    """The states of sequences by key."""

    def find(self, key: _Key) -> PlayState | None:
        """Return the state of a sequence, None if there is none."""

    def keep(self, key: _Key, state: PlayState) -> None:
        """Store the state of a sequence; it may be dropped when it has been silent longest."""

    def remove(self, key: _Key) -> None:
        """Remove the state of a sequence, if there is one."""


class Sequences:
    """The sequences of a service; safe to share between threads.

    states: where their states are; by default in this process alone.
    """

    def __init__(self, states: States | None = None) -> None:
        self._states = OwnStates() if states is None else states
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
            state = None if part.start else self._states.find(key)
            if state is None:
                state = PlayState.unknown(len(types))
            deflections, state = state.follow(np.full(len(q), arrived), q, dq, widths)
            if part.end:
                self._states.remove(key)
            else:
                self._states.keep(key, state)
        return deflections


class OwnStates:
    """The states of sequences of this process."""

    def __init__(self) -> None:
        self._states: OrderedDict[_Key, PlayState] = OrderedDict()  # the one that is silent longest is first

    def __len__(self) -> int:
        """Return the number of sequences."""
        return len(self._states)

    def find(self, key: _Key) -> PlayState | None:
        """Return the state of a sequence, None if there is none."""
        return self._states.get(key)

    def keep(self, key: _Key, state: PlayState) -> None:
        """Store the state of a sequence; drop sequences that are too many, or silent."""
        states = self._states
        states.pop(key, None)
        states[key], now = state, state.packed[0]
        while states and (len(states) > MAX_SEQUENCES or now - next(iter(states.values())).packed[0] > MAX_SILENCE_S):
            states.popitem(last=False)

    def remove(self, key: _Key) -> None:
        """Remove the state of a sequence, if there is one."""
        self._states.pop(key, None)


class SharedStates:
    """The states of sequences of processes that were forked from one, by the hashes of their keys.

    There is no lock between processes: requests of one sequence follow each other.
    max_joints: sequences of arms with more joints begin unknown with every request.
    """

    def __init__(self, max_joints: int, max_sequences: int = MAX_SEQUENCES) -> None:
        width = 1 + len(PlayState.unknown(max_joints).packed)
        numbers = np.frombuffer(mmap.mmap(-1, 8 * max_sequences * width)).reshape(max_sequences, width)
        self._states, self._keys = numbers[:, 1:], numbers[:, :1].view(np.int64)[:, 0]

    def find(self, key: _Key) -> PlayState | None:
        """Return the state of a sequence, None if there is none."""
        place = self._place(key)
        size = len(PlayState.unknown(len(key[1])).packed)
        return None if place is None else PlayState(self._states[place, :size].copy())

    def keep(self, key: _Key, state: PlayState) -> None:
        """Store the state of a sequence, in place of the one that is silent longest of those it may replace."""
        packed, place = state.packed, self._place(key)
        if len(packed) > self._states.shape[1]:
            return
        if place is None:
            places = self._places(key)
            place = int(places[np.argmin(self._states[places, 0])])
        self._keys[place], self._states[place, : len(packed)] = hash(key), packed

    def remove(self, key: _Key) -> None:
        """Remove the state of a sequence, if there is one."""
        if (place := self._place(key)) is not None:
            self._keys[place] = self._states[place, 0] = 0

    def _place(self, key: _Key) -> int | None:
        places = self._places(key)
        found = places[self._keys[places] == hash(key)]
        return int(found[0]) if found.size else None

    def _places(self, key: _Key) -> NDArray[np.int64]:
        return (hash(key) + np.arange(PLACES)) % len(self._keys)
