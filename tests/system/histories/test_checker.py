"""The checker, on consistent and inconsistent histories, and against a brute-force search."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.system.histories.checker import (
    UNKNOWN,
    IsReadOnly,
    Operation,
    State,
    Step,
    find_contradictions,
    find_order,
    never_read_only,
)
from tests.system.histories.rules import ABSENT, Answer, alias, find_faulty_answers, is_alias_read, job, journal


def operation(began: float, ended: float, *call: object, result: object = "moved", client: int = 0) -> Operation:
    return Operation(client, "production", call, result, began, ended)


CONSISTENT = {
    "read concurrent with move sees either version": [
        operation(0, 3, "move", 2),
        operation(1, 2, "read", result=ABSENT),
        operation(1, 4, "read", result=2),
    ],
    "unanswered move takes effect late": [
        operation(0, 1, "move", 1),
        operation(2, 9, "move", 2, result=UNKNOWN),
        operation(3, 4, "read", result=1),
        operation(5, 6, "read", result=2),
    ],
    "unanswered move never takes effect": [
        operation(0, 1, "move", 1),
        operation(2, 9, "move", 2, result=UNKNOWN),
        operation(10, 11, "read", result=1),
    ],
    "either of two concurrent moves is last": [
        operation(0, 5, "move", 1),
        operation(1, 4, "move", 2),
        operation(6, 7, "read", result=1),
        operation(8, 9, "read", result=1),
    ],
    "removal": [
        operation(0, 1, "move", 1),
        operation(2, 3, "remove", result="removed"),
        operation(4, 5, "read", result=ABSENT),
    ],
}
INCONSISTENT = {
    "read of an overwritten version": [
        operation(0, 1, "move", 1),
        operation(2, 3, "move", 2),
        operation(4, 5, "read", result=1),
    ],
    "version goes back": [
        operation(0, 1, "move", 1),
        operation(2, 9, "move", 2),
        operation(3, 4, "read", result=2, client=1),
        operation(5, 6, "read", result=1, client=2),
    ],
    "version that was never set": [operation(0, 1, "move", 1), operation(2, 3, "read", result=3)],
    "removal of an absent alias": [operation(0, 1, "remove", result="removed")],
    "unanswered move is undone": [
        operation(0, 1, "move", 1),
        operation(2, 9, "move", 2, result=UNKNOWN),
        operation(3, 4, "read", result=2),
        operation(5, 6, "read", result=1),
    ],
}


@pytest.mark.parametrize("name", CONSISTENT)
def test_consistent_history_is_accepted(name: str) -> None:
    assert find_order(CONSISTENT[name], ABSENT, alias, is_alias_read) is not None


@pytest.mark.parametrize("name", INCONSISTENT)
def test_inconsistent_history_is_found(name: str) -> None:
    assert find_contradictions(INCONSISTENT[name], ABSENT, alias, is_alias_read) == ["production"]


def batch(began: float, ended: float, stream: int, sequence: int, result: object) -> Operation:
    return Operation(stream, "log", (stream, sequence), result, began, ended)


def test_batches_are_logged_once_and_in_order() -> None:
    log = (-1, -1, 0)
    good = [batch(0, 1, 0, 0, (False, 1)), batch(0, 3, 1, 0, (False, 2)), batch(4, 5, 0, 0, (True, 1))]
    assert find_order(good, log, journal) is not None
    twice = [batch(0, 1, 0, 0, (False, 1)), batch(2, 3, 0, 0, (False, 2))]
    lost = [batch(0, 1, 0, 0, (False, 1)), batch(2, 3, 1, 0, (False, 1))]
    gap = [batch(0, 1, 0, 1, (False, 1))]
    forgotten = [batch(0, 9, 0, 0, UNKNOWN), batch(10, 11, 0, 0, (False, 1)), batch(12, 13, 1, 0, (False, 1))]
    for history in (twice, lost, gap, forgotten):
        assert find_order(history, log, journal) is None


def test_job_ends_once() -> None:
    def reads(*states: str) -> list[Operation]:
        return [Operation(0, "job", ("read",), each, 2 * k, 2 * k + 1) for k, each in enumerate(states)]

    assert find_order(reads("queued", "running", "queued", "running", "succeeded", "succeeded"), "queued", job)
    for states in (("succeeded", "running"), ("cancelled", "succeeded"), ("failed", "queued")):
        assert find_order(reads(*states), "queued", job) is None


def test_job_is_queued_once_and_rejects_late_cancel() -> None:
    def is_consistent(*calls: tuple[str, object]) -> bool:
        history = [Operation(0, "job", (kind,), result, 2 * k, 2 * k + 1) for k, (kind, result) in enumerate(calls)]
        return find_order(history, ABSENT, job) is not None

    assert is_consistent(("queue", "queued"), ("queue", "running"), ("cancel", "running"), ("read", "cancelled"))
    assert is_consistent(("queue", UNKNOWN), ("read", "running"), ("cancel", "ended"), ("read", "failed"))
    assert is_consistent(("queue", "queued"), ("cancel", UNKNOWN), ("read", "queued"), ("read", "cancelled"))
    assert not is_consistent(("read", "queued"))
    assert not is_consistent(("queue", "queued"), ("cancel", "cancelled"), ("read", "succeeded"))
    assert not is_consistent(("queue", "queued"), ("read", "succeeded"), ("cancel", "cancelled"))
    assert not is_consistent(("queue", "queued"), ("cancel", "ended"), ("read", "running"))


def test_answers_match_log_and_never_go_back() -> None:
    def expected(revision: int) -> tuple[float, float]:
        return 1.0, float(revision)

    def answer(revision: int, server_start: str = "0:7", min_revision: int = 0, tau_error: float = 0.0) -> Answer:
        return Answer(0, server_start, 3, revision, min_revision, (1.0 + tau_error, float(revision)))

    good = [answer(0), answer(4), answer(4), answer(2, server_start="1:8"), answer(5, min_revision=5)]
    assert find_faulty_answers(good, expected) == []
    for bad in (answer(3), answer(9, tau_error=1e-6), answer(9, min_revision=10)):
        assert len(find_faulty_answers([*good, bad], expected)) == 1


RULES: dict[str, tuple[State, Step, IsReadOnly]] = {
    "alias": (ABSENT, alias, is_alias_read),
    "journal": ((-1, -1, 0), journal, never_read_only),
    "job": (ABSENT, job, never_read_only),
}


def random_call(rule: str, rng: np.random.Generator) -> tuple[object, ...]:
    if rule == "alias":
        return [("move", int(rng.integers(1, 3))), ("read",), ("remove",)][rng.integers(3)]
    if rule == "journal":
        return int(rng.integers(2)), int(rng.integers(3))
    return [("queue",), ("read",), ("cancel",)][rng.integers(3)]


def possible_results(rule: str, call: tuple[object, ...]) -> list[object]:
    """Return all possible results of a call."""
    if rule == "alias":
        return {"move": ["moved"], "read": [ABSENT, 1, 2], "remove": ["removed", "absent"]}[str(call[0])]
    if rule == "journal":
        return [(duplicate, revision) for duplicate in (False, True) for revision in range(1, 6)]
    return ["queued", "running", "succeeded", "cancelled", *(["ended"] if call[0] == "cancel" else [])]


@pytest.mark.parametrize("rule", RULES)
@given(st.integers(0, 10**6))
@settings(max_examples=40)
def test_history_generated_in_order_is_accepted(rule: str, seed: int) -> None:
    """Each call takes effect between its start and end; some unanswered ones do, others never."""
    rng = np.random.default_rng(seed)
    state, step, is_read_only = RULES[rule]
    history: list[Operation] = []
    for moment in range(60):
        call = random_call(rule, rng)
        began, ended = moment - rng.exponential(4.0), moment + rng.exponential(4.0)
        operations = [Operation(moment, rule, call, each, began, ended) for each in possible_results(rule, call)]
        possible = [(each, after) for each in operations for after in step(state, each)]
        if not possible:  # impossible, as reading a job that does not exist
            continue
        chosen, after = possible[rng.integers(len(possible))]
        if rng.random() < 0.2:
            chosen = replace(chosen, result=UNKNOWN)
            # the state must be one that an unanswered call can cause
            after = state if rng.random() < 0.5 else ([*step(state, chosen)] or [state])[-1]
        history.append(chosen)
        state = after
    assert find_order(history, RULES[rule][0], step, is_read_only) is not None


@pytest.mark.parametrize("rule", RULES)
@given(st.integers(0, 10**6))
@settings(max_examples=40)
def test_checker_agrees_with_brute_force(rule: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    initial, step, is_read_only = RULES[rule]
    history = []
    for client in range(5):
        call = random_call(rule, rng)
        began, allowed = rng.uniform(0, 10), possible_results(rule, call)
        result = UNKNOWN if rng.random() < 0.25 else allowed[rng.integers(len(allowed))]
        history.append(Operation(client, rule, call, result, began, began + rng.uniform(0, 6)))
    assert (find_order(history, initial, step, is_read_only) is not None) == has_order_by_brute_force(
        history, initial, step
    )


def has_order_by_brute_force(history: list[Operation], initial: State, step: Step) -> bool:
    """Try every order of every subset that contains all answered operations."""
    needed = {each.client for each in history if each.answered}
    for size in range(len(needed), len(history) + 1):
        for order in permutations(history, size):
            if needed <= {each.client for each in order} and respects_time(order) and is_allowed(order, initial, step):
                return True
    return False


def respects_time(order: tuple[Operation, ...]) -> bool:
    """Return whether no operation follows one that began after its end."""
    return all(
        not (later.answered and later.ended < earlier.began)
        for place, earlier in enumerate(order)
        for later in order[place + 1 :]
    )


def is_allowed(order: tuple[Operation, ...], initial: State, step: Step) -> bool:
    states = {initial}
    for each in order:
        states = {after for state in states for after in step(state, each)}
    return bool(states)


def test_long_history_is_checked() -> None:
    """Thousands of operations, hundreds of them unanswered, as in a run of minutes."""
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
    assert find_order(history, ABSENT, alias, is_alias_read) is not None
    wrong = [*history, operation(3_100, 3_101, "read", result=7)]
    assert find_order(wrong[-500:], 1, alias, is_alias_read) is None
