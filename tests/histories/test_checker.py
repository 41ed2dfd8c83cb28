"""The checker against histories that are known good, and known bad; and against a slow one that tries every order."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.histories.checker import UNKNOWN, Operation, contradictions, explained
from tests.histories.rules import ABSENT, alias, job, journal


def at(began: float, ended: float, *call: object, result: object = "moved", client: int = 0) -> Operation:
    return Operation(client, "production", call, result, began, ended)


GOOD = {
    "a read beside a move sees either": [
        at(0, 3, "move", 2),
        at(1, 2, "read", result=ABSENT),
        at(1, 4, "read", result=2),
    ],
    "a move whose answer was lost may show late": [
        at(0, 1, "move", 1),
        at(2, 9, "move", 2, result=UNKNOWN),
        at(3, 4, "read", result=1),
        at(5, 6, "read", result=2),
    ],
    "or never": [at(0, 1, "move", 1), at(2, 9, "move", 2, result=UNKNOWN), at(10, 11, "read", result=1)],
    "of two moves at once either is the last": [
        at(0, 5, "move", 1),
        at(1, 4, "move", 2),
        at(6, 7, "read", result=1),
        at(8, 9, "read", result=1),
    ],
    "a removal": [at(0, 1, "move", 1), at(2, 3, "remove", result="removed"), at(4, 5, "read", result=ABSENT)],
}
BAD = {
    "a read of before": [at(0, 1, "move", 1), at(2, 3, "move", 2), at(4, 5, "read", result=1)],
    "there and back": [
        at(0, 1, "move", 1),
        at(2, 9, "move", 2),
        at(3, 4, "read", result=2, client=1),
        at(5, 6, "read", result=1, client=2),
    ],
    "a version nobody named": [at(0, 1, "move", 1), at(2, 3, "read", result=3)],
    "removed what was not there": [at(0, 1, "remove", result="removed")],
    "a lost move that shows and is gone": [
        at(0, 1, "move", 1),
        at(2, 9, "move", 2, result=UNKNOWN),
        at(3, 4, "read", result=2),
        at(5, 6, "read", result=1),
    ],
}


@pytest.mark.parametrize("name", GOOD)
def test_what_can_be_explained_is(name: str) -> None:
    assert explained(GOOD[name], ABSENT, alias) is not None


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_explained_is_found(name: str) -> None:
    assert contradictions(BAD[name], ABSENT, alias) == ["production"]


def batch(began: float, ended: float, stream: int, sequence: int, result: object) -> Operation:
    return Operation(stream, "log", (stream, sequence), result, began, ended)


def test_batches_are_logged_once_and_in_order() -> None:
    log = (-1, -1, 0)
    good = [batch(0, 1, 0, 0, (False, 1)), batch(0, 3, 1, 0, (False, 2)), batch(4, 5, 0, 0, (True, 1))]
    assert explained(good, log, journal) is not None
    twice = [batch(0, 1, 0, 0, (False, 1)), batch(2, 3, 0, 0, (False, 2))]
    lost = [batch(0, 1, 0, 0, (False, 1)), batch(2, 3, 1, 0, (False, 1))]
    gap = [batch(0, 1, 0, 1, (False, 1))]
    forgotten = [batch(0, 9, 0, 0, UNKNOWN), batch(10, 11, 0, 0, (False, 1)), batch(12, 13, 1, 0, (False, 1))]
    for history in (twice, lost, gap, forgotten):
        assert explained(history, log, journal) is None


def test_a_job_ends_once() -> None:
    def seen(*states: str) -> list[Operation]:
        return [Operation(0, "job", ("read",), each, 2 * k, 2 * k + 1) for k, each in enumerate(states)]

    assert explained(seen("queued", "running", "queued", "running", "succeeded", "succeeded"), "queued", job)
    for states in (("succeeded", "running"), ("cancelled", "succeeded"), ("failed", "queued")):
        assert explained(seen(*states), "queued", job) is None


@given(st.integers(0, 10**6))
def test_it_agrees_with_trying_every_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    history = []
    for client in range(5):
        began, length = rng.uniform(0, 10), rng.uniform(0, 6)
        version = int(rng.integers(1, 3))
        call, result = (("move", version), "moved") if rng.random() < 0.5 else (("read",), version)
        if call[0] == "move" and rng.random() < 0.2:
            result = UNKNOWN
        history.append(Operation(client, "production", call, result, began, began + length))
    assert (explained(history, ABSENT, alias) is not None) == slowly(history)


def slowly(history: list[Operation]) -> bool:
    """By every order of every set of the operations that holds all with an answer."""
    needed = {each.client for each in history if each.certain}
    for size in range(len(needed), len(history) + 1):
        for order in permutations(history, size):
            if needed <= {each.client for each in order} and in_time(order) and holds(order):
                return True
    return False


def in_time(order: tuple[Operation, ...]) -> bool:
    """Whether nothing is put before what had ended when it began."""
    return all(
        not (later.certain and later.ended < earlier.began)
        for place, earlier in enumerate(order)
        for later in order[place + 1 :]
    )


def holds(order: tuple[Operation, ...]) -> bool:
    state = ABSENT
    for each in order:
        after = list(alias(state, each))
        if not after:
            return False
        (state,) = after
    return True
