"""What was unlearnt or rolled back leaves nothing behind, wherever the log is read from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.learning.learner import course
from service.learning.learner import restore as restoring
from service.learning.learner.course import RewoundError
from tests.service.learning.pendulums import (
    at_once,
    differ,
    rows,
    same,
)


@pytest.mark.parametrize("at", [None, 1, 3, 5], ids="snapshot at {}".format)
def test_a_batch_that_was_unlearnt_leaves_nothing_behind(arm, pages, at):
    arm.batches(*range(6))
    if at is not None:
        arm.snapshot(at_most=at)
    known = arm.restored()
    assert arm.unlearn(3) == 7
    expected = at_once([0, 1, 3, 4, 5])
    assert differ(expected, at_once(range(6)))
    same(arm.restored().online, expected)
    same(arm.followed(known).online, expected)
    arm.batches(6)
    same(arm.restored().online, at_once([0, 1, 3, 4, 5, 6]))
    same(arm.followed(known).online, at_once([0, 1, 3, 4, 5, 6]))


def test_replays_go_with_their_batch(arm):
    code = np.array([0] * 5 + [6] * 5, np.uint8)
    arm.batch(0)
    arm.batch(1, rows=replace(rows(1), code=code))
    arm.event("replay", replace(rows(1), code=6 - code), event=2)
    known = arm.restored()
    same(known.online, at_once([0, 1]))
    arm.unlearn(2)
    same(arm.followed(known).online, at_once([0]))
    same(arm.restored().online, at_once([0]))


def test_unlearning_twice_is_unlearning_once(arm):
    arm.batches(0, 1)
    known = arm.restored()
    arm.unlearn(1)
    known = arm.followed(known)
    assert arm.snapshot() == 3
    arm.unlearn(1)
    same(arm.followed(known).online, at_once([1]))
    same(arm.restored().online, at_once([1]))


def test_a_batch_that_is_unlearnt_later_is_learnt_at_its_place(arm, monkeypatch):
    monkeypatch.setattr(course, "PAGE_ROWS", 10)
    arm.batches(*range(4))
    arm.unlearn(1)
    known = arm.restored(most_rows=30)
    assert known.number == 3
    same(known.online, at_once(range(3)))
    same(arm.followed(known).online, at_once([1, 2, 3]))


def test_what_was_unlearnt_while_the_pages_were_read_is_taken_out_once(arm, monkeypatch):
    monkeypatch.setattr(course, "PAGE_ROWS", 10)
    arm.batches(*range(6))
    known = arm.restored(most_rows=30)
    assert known.number == 3
    arm.unlearn(2)
    arm.unlearn(5)
    same(arm.followed(known).online, at_once([0, 2, 3, 5]))


def test_a_rollback_leads_back(arm, pages):
    arm.batches(*range(4))
    arm.snapshot()
    arm.batches(4, 5, 6)
    arm.snapshot()
    known = arm.restored()
    assert arm.rollback(5) == 8
    same(arm.restored().online, at_once(range(5)))
    with pytest.raises(RewoundError) as rewound:
        arm.followed(known)
    assert rewound.value.number == 5
    arm.batches(7)
    same(arm.restored().online, at_once([0, 1, 2, 3, 4, 7]))
    assert arm.restored().number == 9


def test_a_rollback_reaches_what_was_read_in_between_and_no_more(arm, monkeypatch):
    monkeypatch.setattr(course, "PAGE_ROWS", 10)
    arm.batches(*range(4))
    known = arm.restored(most_rows=20)
    assert known.number == 2
    arm.rollback(3)
    same(arm.followed(known).online, at_once(range(3)))
    arm.rollback(1)
    with pytest.raises(RewoundError):
        arm.followed(known)


def test_a_rollback_between_two_pages_of_a_restart_is_followed(arm, monkeypatch):
    monkeypatch.setattr(course, "PAGE_ROWS", 10)
    arm.batches(*range(6))
    calls, real = [], restoring.advance

    def disturbed(*arguments):
        calls.append(arguments)
        if len(calls) == 5:
            arm.rollback(2)
        return real(*arguments)

    monkeypatch.setattr(restoring, "advance", disturbed)
    found = arm.restored()
    assert found.number == 7
    same(found.online, at_once(range(2)))


def test_what_was_unlearnt_stays_unlearnt_after_a_rollback(arm):
    arm.batches(*range(4))
    arm.snapshot()
    arm.unlearn(2)
    arm.batches(4)
    arm.rollback(4)
    same(arm.restored().online, at_once([0, 2, 3]))


def test_a_batch_that_was_rolled_back_cannot_be_taken_out_again(arm):
    arm.batches(*range(4))
    arm.rollback(2)
    known = arm.restored()
    arm.unlearn(4)
    same(arm.followed(known).online, at_once(range(2)))
    same(arm.restored().online, at_once(range(2)))


def test_the_state_of_an_earlier_event_is_told_with_or_without_what_has_been_unlearnt_since(arm):
    arm.batches(*range(5))
    arm.snapshot(at_most=3)
    arm.unlearn(2)
    same(arm.restored(at_most=3).online, at_once(range(3)))
    found = arm.restored(at_most=3, taken_back=True)
    assert found.number == 3
    same(found.online, at_once([0, 2]))
