"""What a service promises of the things that histories are about, as states and the results that they allow."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from tests.histories.checker import Operation

ABSENT = None
"""No such alias, batch or job yet."""


def alias(version: int | None, operation: Operation) -> Iterable[int | None]:
    """An alias names the version that it was moved to last, for who asks about it and for who asks through it."""
    kind, *arguments = operation.call
    if kind == "move":
        return [arguments[0]]
    if kind == "remove":
        gone = operation.result in ("removed", "unknown")
        return [ABSENT] if gone == (version is not ABSENT) or not operation.certain else []
    # read: by the list of aliases, or by the version that answered a query
    return [version] if operation.result == version else []


def reads(operation: Operation) -> bool:
    """Whether an operation on an alias only looks."""
    return operation.call[0] == "read"


Batches = tuple[int, ...]
"""Of each stream, the last sequence that is logged; then the revision, which every batch counts up by one."""


def journal(state: Batches, operation: Operation) -> Iterable[Batches]:
    """A batch is logged once, in the order of its stream, and its revision is the number of batches so far.

    A batch that comes again is answered by what was said the first time.
    """
    *lasts, revision = state
    stream, sequence = operation.call
    after = list(state)
    if sequence <= lasts[stream]:
        again = not operation.certain or operation.result[0]
        return [state] if again else []
    if not operation.certain:
        after[stream], after[-1] = sequence, revision + 1
        return [tuple(after)]
    duplicate, said = operation.result
    if duplicate or said != revision + 1 or sequence != lasts[stream] + 1:
        return []
    after[stream], after[-1] = sequence, revision + 1
    return [tuple(after)]


ENDS = ("succeeded", "failed", "cancelled")
LATER: dict[str | None, tuple[str, ...]] = {
    "queued": ("queued", "running", *ENDS),
    "running": ("running", "queued", *ENDS),  # queued: again after its worker died
    **{end: (end,) for end in ENDS},
}


def job(state: str | None, operation: Operation) -> Iterable[str | None]:
    """A job is queued once, however often that is asked; it moves on by itself, and ends once.

    A cancel that was granted ends a job that waits; one that is refused shows that the job had ended.
    """
    (kind,), result = operation.call, operation.result
    if state is ABSENT:
        if kind != "queue":
            return []
        return [result if operation.certain else "queued"]
    if not operation.certain:
        return ["cancelled", state] if kind == "cancel" and state in ("queued", "running") else [state]
    if result == "ended":
        return [end for end in ENDS if end in LATER[state]]
    return [result] if result in LATER[state] else []


@dataclass(frozen=True)
class Answer:
    """What a client was answered. life: which start of a service; least: the revision that it asked for at least;
    tau: torques at the queries that all ask, N·m."""

    client: int
    life: str
    version: int
    revision: int
    least: int
    tau: tuple[float, ...]


def faults(answers: Sequence[Answer], expected: Callable[[int], Sequence[float]], tolerance: float = 1e-8) -> list[str]:
    """What is wrong with answers, in the order in which they came to each client.

    A client that asks one start of a service does not go back to an earlier revision; nobody gets less than the
    revision asked for; and torques are those of the log up to the revision, `expected` of it, whoever answers.
    """
    newest: dict[tuple[int, str, int], int] = {}
    found: list[str] = []
    torques: dict[int, Sequence[float]] = {}
    for each in answers:
        place = each.client, each.life, each.version
        if each.revision < newest.get(place, 0):
            found.append(f"client {each.client} saw revision {each.revision} after {newest[place]} at {each.life}")
        newest[place] = max(newest.get(place, 0), each.revision)
        if each.revision < each.least:
            found.append(f"revision {each.revision} was answered where {each.least} was asked for")
        if each.revision not in torques:
            torques[each.revision] = expected(each.revision)
        right = torques[each.revision]
        scale = max(map(abs, right))
        if max(abs(a - b) for a, b in zip(each.tau, right, strict=True)) > tolerance * scale:
            found.append(f"torques of revision {each.revision} at {each.life} are not those of the log")
    return found
