"""The promises of the service as state machines: states, and the results that they allow."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from tests.system.histories.checker import Operation

ABSENT = None
"""The alias or job does not exist."""


def alias(version: int | None, operation: Operation) -> Iterable[int | None]:
    """An alias names the version of its last move, in lists and in predictions."""
    kind, *arguments = operation.call
    if kind == "move":
        return [arguments[0]]
    if kind == "remove":
        gone = operation.result in ("removed", "unknown")
        return [ABSENT] if gone == (version is not ABSENT) or not operation.answered else []
    # by the list of aliases, or by the version of a prediction
    return [version] if operation.result == version else []


def is_alias_read(operation: Operation) -> bool:
    """Return whether an operation on an alias is read-only."""
    return operation.call[0] == "read"


Batches = tuple[int, ...]
"""The last logged sequence of each stream, then the revision, which every batch increments."""


def journal(state: Batches, operation: Operation) -> Iterable[Batches]:
    """A batch is logged once, in the order of its stream, and its revision is the number of batches so far.

    A duplicate gets the response of the first request.
    """
    *last_sequences, revision = state
    stream, sequence = operation.call
    after = list(state)
    if sequence <= last_sequences[stream]:
        is_duplicate = not operation.answered or operation.result[0]
        return [state] if is_duplicate else []
    if not operation.answered:
        after[stream], after[-1] = sequence, revision + 1
        return [tuple(after)]
    duplicate, reported_revision = operation.result
    if duplicate or reported_revision != revision + 1 or sequence != last_sequences[stream] + 1:
        return []
    after[stream], after[-1] = sequence, revision + 1
    return [tuple(after)]


END_STATES = ("succeeded", "failed", "cancelled")
NEXT_STATES: dict[str | None, tuple[str, ...]] = {
    "queued": ("queued", "running", *END_STATES),
    "running": ("running", "queued", *END_STATES),  # queued: again after its worker died
    **{end: (end,) for end in END_STATES},
}


def job(state: str | None, operation: Operation) -> Iterable[str | None]:
    """A job is queued once per idempotency key; it progresses by itself, and ends once.

    A successful cancel ends a queued job; a rejected one shows that the job had ended.
    """
    (kind,), result = operation.call, operation.result
    if state is ABSENT:
        if kind != "queue":
            return []
        return [result if operation.answered else "queued"]
    if not operation.answered:
        return ["cancelled", state] if kind == "cancel" and state in ("queued", "running") else [state]
    if result == "ended":
        return [end for end in END_STATES if end in NEXT_STATES[state]]
    return [result] if result in NEXT_STATES[state] else []


@dataclass(frozen=True)
class Answer:
    """Response to a prediction. server_start: identifies the process; min_revision: of the request; tau: torques at the
    common queries, N·m."""

    client: int
    server_start: str
    version: int
    revision: int
    min_revision: int
    tau: tuple[float, ...]


def find_faulty_answers(
    answers: Sequence[Answer], expected: Callable[[int], Sequence[float]], tolerance: float = 1e-8
) -> list[str]:
    """Return what is wrong with predictions, given in the order in which each client received them.

    Revisions of one server process never go back for a client; no revision is below the requested minimum; torques are
    those of the log up to the revision, as `expected` returns them.
    """
    newest: dict[tuple[int, str, int], int] = {}
    found: list[str] = []
    torques: dict[int, Sequence[float]] = {}
    for each in answers:
        position = each.client, each.server_start, each.version
        if each.revision < newest.get(position, 0):
            found.append(
                f"client {each.client} saw revision {each.revision} after {newest[position]} at {each.server_start}"
            )
        newest[position] = max(newest.get(position, 0), each.revision)
        if each.revision < each.min_revision:
            found.append(f"revision {each.revision} was answered where {each.min_revision} was asked for")
        if each.revision not in torques:
            torques[each.revision] = expected(each.revision)
        expected_tau = torques[each.revision]
        scale = max(map(abs, expected_tau))
        if max(abs(a - b) for a, b in zip(each.tau, expected_tau, strict=True)) > tolerance * scale:
            found.append(f"torques of revision {each.revision} at {each.server_start} are not those of the log")
    return found
