"""What a service promises of the things that histories are about, as states and the results that they allow."""

from __future__ import annotations

from collections.abc import Iterable

from tests.histories.checker import Operation

ABSENT = None
"""No such alias, or no such batch yet."""


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


ORDER = ("queued", "running", "succeeded", "failed", "cancelled")
LATER = {
    "queued": ORDER,
    "running": ("running", "queued", "succeeded", "failed", "cancelled"),  # queued: again after its worker died
    "succeeded": ("succeeded",),
    "failed": ("failed",),
    "cancelled": ("cancelled",),
}


def job(state: str, operation: Operation) -> Iterable[str]:
    """A job moves on by itself, ends once, and a cancel that was granted is the end of one that had not ended."""
    (kind,) = operation.call
    if not operation.certain:
        return ["cancelled"] if kind == "cancel" and state in ("queued", "running") else [state]
    return [operation.result] if operation.result in LATER[state] else []
