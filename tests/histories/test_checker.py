"""The checker against histories that are known good, and known bad; and against a slow one that tries every order."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.histories.checker import UNKNOWN, Looks, Operation, State, Step, contradictions, explained, never
from tests.histories.rules import ABSENT, Answer, alias, faults, job, journal, reads


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
    assert explained(GOOD[name], ABSENT, alias, reads) is not None


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_explained_is_found(name: str) -> None:
    assert contradictions(BAD[name], ABSENT, alias, reads) == ["production"]


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


def test_a_job_is_queued_once_and_a_cancel_says_whether_it_had_ended() -> None:
    def done(*calls: tuple[str, object]) -> bool:
        history = [Operation(0, "job", (kind,), result, 2 * k, 2 * k + 1) for k, (kind, result) in enumerate(calls)]
        return explained(history, ABSENT, job) is not None

    assert done(("queue", "queued"), ("queue", "running"), ("cancel", "running"), ("read", "cancelled"))
    assert done(("queue", UNKNOWN), ("read", "running"), ("cancel", "ended"), ("read", "failed"))
    assert done(("queue", "queued"), ("cancel", UNKNOWN), ("read", "queued"), ("read", "cancelled"))
    assert not done(("read", "queued"))
    assert not done(("queue", "queued"), ("cancel", "cancelled"), ("read", "succeeded"))
    assert not done(("queue", "queued"), ("read", "succeeded"), ("cancel", "cancelled"))
    assert not done(("queue", "queued"), ("cancel", "ended"), ("read", "running"))


def test_answers_are_those_of_the_log_and_do_not_go_back() -> None:
    def expected(revision: int) -> tuple[float, float]:
        return 1.0, float(revision)

    def answer(revision: int, life: str = "0:7", least: int = 0, off: float = 0.0) -> Answer:
        return Answer(0, life, 3, revision, least, (1.0 + off, float(revision)))

    good = [answer(0), answer(4), answer(4), answer(2, life="1:8"), answer(5, least=5)]
    assert faults(good, expected) == []
    for bad in (answer(3), answer(9, off=1e-6), answer(9, least=10)):
        assert len(faults([*good, bad], expected)) == 1


RULES: dict[str, tuple[State, Step, Looks]] = {
    "alias": (ABSENT, alias, reads),
    "journal": ((-1, -1, 0), journal, never),
    "job": (ABSENT, job, never),
}


def asked(rule: str, rng: np.random.Generator) -> tuple[object, ...]:
    if rule == "alias":
        return [("move", int(rng.integers(1, 3))), ("read",), ("remove",)][rng.integers(3)]
    if rule == "journal":
        return int(rng.integers(2)), int(rng.integers(3))
    return [("queue",), ("read",), ("cancel",)][rng.integers(3)]


def results(rule: str, call: tuple[object, ...]) -> list[object]:
    """All that may be answered to a call."""
    if rule == "alias":
        return {"move": ["moved"], "read": [ABSENT, 1, 2], "remove": ["removed", "absent"]}[str(call[0])]
    if rule == "journal":
        return [(known, revision) for known in (False, True) for revision in range(1, 6)]
    return ["queued", "running", "succeeded", "cancelled", *(["ended"] if call[0] == "cancel" else [])]


@pytest.mark.parametrize("rule", RULES)
@given(st.integers(0, 10**6))
@settings(max_examples=40)
def test_what_happened_in_an_order_is_explained(rule: str, seed: int) -> None:
    """Each call takes effect at a moment within it; of those without an answer some do, and some never."""
    rng = np.random.default_rng(seed)
    state, step, looks = RULES[rule]
    history: list[Operation] = []
    for moment in range(60):
        call = asked(rule, rng)
        began, ended = moment - rng.exponential(4.0), moment + rng.exponential(4.0)
        operations = [Operation(moment, rule, call, each, began, ended) for each in results(rule, call)]
        possible = [(each, after) for each in operations for after in step(state, each)]
        if not possible:  # nobody asks so: to look at a job that is not there
            continue
        chosen, after = possible[rng.integers(len(possible))]
        if rng.random() < 0.2:
            chosen = replace(chosen, result=UNKNOWN)
            # what it leads to has to be what one without an answer may lead to
            after = state if rng.random() < 0.5 else ([*step(state, chosen)] or [state])[-1]
        history.append(chosen)
        state = after
    assert explained(history, RULES[rule][0], step, looks) is not None


@pytest.mark.parametrize("rule", RULES)
@given(st.integers(0, 10**6))
@settings(max_examples=40)
def test_it_agrees_with_trying_every_order(rule: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    initial, step, looks = RULES[rule]
    history = []
    for client in range(5):
        call = asked(rule, rng)
        began, told = rng.uniform(0, 10), results(rule, call)
        result = UNKNOWN if rng.random() < 0.25 else told[rng.integers(len(told))]
        history.append(Operation(client, rule, call, result, began, began + rng.uniform(0, 6)))
    assert (explained(history, initial, step, looks) is not None) == slowly(history, initial, step)


def slowly(history: list[Operation], initial: State, step: Step) -> bool:
    """By every order of every set of the operations that holds all with an answer."""
    needed = {each.client for each in history if each.certain}
    for size in range(len(needed), len(history) + 1):
        for order in permutations(history, size):
            if needed <= {each.client for each in order} and in_time(order) and holds(order, initial, step):
                return True
    return False


def in_time(order: tuple[Operation, ...]) -> bool:
    """Whether nothing is put before what had ended when it began."""
    return all(
        not (later.certain and later.ended < earlier.began)
        for place, earlier in enumerate(order)
        for later in order[place + 1 :]
    )


def holds(order: tuple[Operation, ...], initial: State, step: Step) -> bool:
    states = {initial}
    for each in order:
        states = {after for state in states for after in step(state, each)}
    return bool(states)


def test_long_histories_are_explained_too() -> None:
    """Thousands of operations, hundreds of them without an answer: what a run of minutes leaves."""
    rng = np.random.default_rng(1)
    version, history = ABSENT, []
    for moment in range(3_000):
        moves = rng.random() < 0.4
        call = ("move", int(rng.integers(1, 4))) if moves else ("read",)
        result = "moved" if moves else version
        happens = True
        if rng.random() < 0.05:
            result, happens = UNKNOWN, rng.random() < 0.5
        version = call[1] if moves and happens else version
        began, ended = moment - rng.exponential(3.0), moment + rng.exponential(3.0)
        history.append(Operation(0, "production", call, result, began, ended))
    assert explained(history, ABSENT, alias, reads) is not None
    wrong = [*history, at(3_100, 3_101, "read", result=7)]
    assert explained(wrong[-500:], 1, alias, reads) is None
