"""The state after an event is a function of the log up to it, to the last bit: whoever makes it, when and how."""

import hashlib
import multiprocessing
import tempfile
from ast import literal_eval
from contextlib import ExitStack
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule
from sqlalchemy import delete
from threadpoolctl import threadpool_limits

from lipcore.online import transfer
from lipcore.online.transfer import Revision
from service.cli.verify import verify_home
from service.foundation.settings import Settings
from service.journal import log, snapshots
from service.journal import restore as restoring
from service.journal.floor import error_floor_of
from service.journal.restore import RestoredState, advance, restore
from service.storage.database import Database, EventRow, SnapshotRow
from service.storage.files import Files
from tests.service.learning.folding import Fold
from tests.service.learning.pendulums import ARM, BEGIN, Arm, make_rows, residual_record, trained_model

SIZE = 3
"""Rows of a batch."""


class LearningMachine(RuleBasedStateMachine):
    """A log that grows, and a learner that follows it; every state of the learner is checked against `Fold`."""

    @initialize(page_rows=st.sampled_from([1, 4, 6, 500]), trained_on=st.sampled_from([0, 0, 4]))
    def open(self, page_rows: int, trained_on: int = 0) -> None:
        """Make a home with a version that contains the first events by training."""
        self.resources = ExitStack()
        folder = self.resources.enter_context(tempfile.TemporaryDirectory())
        patch = self.resources.enter_context(pytest.MonkeyPatch.context())
        patch.setattr(restoring, "PAGE_ROWS", page_rows)
        self.arm, self.base = Arm.open(Path(folder)), trained_model()
        self.resources.callback(self.arm.database.close)
        self.start, self.version, self.undone = 0, 1, set[int]()
        for number in range(trained_on):
            self.settings(2.0) if number == 1 else self.batch(number)
        if trained_on:
            self.start, self.version = trained_on, self.arm.publish(candidate=True, start=trained_on)
        self.restart()

    def _events(self) -> list[EventRow]:
        with self.arm.database.session() as session:
            return log.events(session, ARM, 0, 1000, void=True)

    def _batches(self) -> list[int]:
        return [each.number for each in self._events() if each.kind == "batch"]

    @rule(at=st.integers(0, 30))
    def batch(self, at: int) -> None:
        """Log the next batch, with the rows of a place of the recording."""
        self.arm.log_batch(len(self._batches()), rows=make_rows(at, SIZE), received=BEGIN + at / 10)

    @rule(at=st.integers(0, 30))
    def change(self, at: int) -> None:
        self.arm.log_event("change", t=BEGIN + at / 30)

    @rule(forgetting_s=st.sampled_from([None, 0.5, 2.0]))
    def settings(self, forgetting_s: float | None) -> None:
        self.arm.log_event("settings", forgetting_s=forgetting_s)

    @rule(seconds=st.sampled_from([None, 2.0]))
    def friction_walk(self, seconds: float | None) -> None:
        self.arm.log_event("settings", forgetting_s=None, friction_walk_s=seconds)

    @rule(choice=st.integers(0, 100))
    def unlearn(self, choice: int) -> None:
        if batches := self._batches():
            self.arm.unlearn(batches[choice % len(batches)])

    @rule(choice=st.integers(0, 100))
    def replay(self, choice: int) -> None:
        """Learn rows of a batch that were rejected, if it was not undone."""
        batches = self._batches()
        if batches and not self.arm.find(batch := batches[choice % len(batches)]).void:
            self.arm.log_event("replay", make_rows(40 + choice % 20, SIZE), event=batch, codes=["contact"])

    @rule(choice=st.integers(0, 100))
    def rollback(self, choice: int) -> None:
        if (last := len(self._events())) > 1:
            free = [each for each in range(last) if each not in self.undone]
            to = free[choice % len(free)]
            self.undone |= set(range(to + 1, last + 1))
            self.arm.rollback(to)

    @rule(pages=st.integers(1, 4))
    def follow(self, pages: int) -> None:
        self.known = self._followed(self.known, pages)

    @rule()
    def store(self) -> None:
        if self.known.number > self.start:
            place = ARM, self.version, self.known.number, self.known.seen
            snapshots.save(self.arm.database, self.arm.files, *place, transfer.dump(self.known.online), most=4)

    @rule()
    def restart(self) -> None:
        self.known = restore(self.arm.database, self.arm.files, ARM, self.version, self.base, pages=0)

    def _followed(self, known: RestoredState, pages: int | None = None) -> RestoredState:
        """Learn some pages, or all; check every state."""
        fold = Fold(self.base, self._events(), self.start)
        while pages is None or pages > 0:
            following = advance(self.arm.database, self.arm.files, known)
            if following is known:
                return known
            known, pages = following, pages and pages - 1
            assert transfer.dump(known.online) == transfer.dump(fold.after(known.number)), known.number
        return known

    def teardown(self) -> None:
        """All ways to the end of the log lead to the same bits."""
        if not hasattr(self, "known"):
            return
        with self.resources:
            states = [self._followed(self.known)]
            assert verify_home(self.arm.settings).damages == []
            for _ in ("newest snapshot", "no snapshot"):
                self.restart()
                states.append(self._followed(self.known))
                with self.arm.database.transaction() as session:
                    session.execute(delete(SnapshotRow))
            assert {each.number for each in states} == {max(len(self._events()), self.start)}
            assert len({transfer.dump(each.online) for each in states}) == 1


TestLearning = LearningMachine.TestCase
TestLearning.settings = settings(
    deadline=None, derandomize=True, stateful_step_count=20, suppress_health_check=list(HealthCheck)
)

FAILED_ONCE = {
    "two changes": (3, "batch 0, change 3, batch 5, change 20, batch 9, follow 2, store, unlearn 0, batch 11"),
    "two changes and a rollback": (
        3,
        "batch 0, change 3, batch 5, change 20, batch 9, follow 3, store, "
        "unlearn 0, unlearn 1, batch 11, rollback 3, follow 3, store",
    ),
    "undone twice": (
        500,
        "batch 0, unlearn 0, unlearn 0, batch 2, rollback 3, batch 3, rollback 1, follow 9, store",
    ),
    "drifting friction": (
        6,
        "friction_walk 2, batch 0, batch 1, batch 30, batch 8, batch 12, batch 16, batch 2, batch 20, "
        "follow 3, store, unlearn 0, unlearn 7, friction_walk None, rollback 5, follow 9, store",
    ),
    "another weight": (3, "batch 1, settings 2, batch 2, follow 9, unlearn 0, rollback 3, follow 9, store"),
}
"""Rows of a page, and steps, of logs on which a learner was wrong once."""


@pytest.mark.parametrize(("page_rows", "steps"), FAILED_ONCE.values(), ids=FAILED_ONCE)
def test_logs_that_were_learnt_wrongly_once_are_learnt_as_defined(page_rows, steps):
    machine = LearningMachine()
    machine.open(page_rows)
    for step in steps.split(", "):
        name, *values = step.split()
        getattr(machine, name)(*map(literal_eval, values))
    machine.teardown()


def make_state(home: Path, page_rows: int) -> list[str]:
    """Return digests of the state of a log and of the answers that are solved from it."""
    threadpool_limits(1)
    restoring.PAGE_ROWS = page_rows
    arm = Arm(Database(home), Files(home), Settings(home=home))
    known = arm.restore_state()
    revision = Revision.of(known.online.model(error_floor_of(arm.database, ARM, 1, known.number, 2)))
    arrays = [getattr(revision, each.name) for each in fields(revision)]
    arm.database.close()
    made = [transfer.dump(known.online), *(np.ascontiguousarray(each).tobytes() for each in arrays)]
    return [hashlib.sha256(each).hexdigest() for each in made]


def make_state_in_process(home: Path, page_rows: int) -> list[str]:
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(make_state, (home, page_rows))


@pytest.mark.slow
def test_two_processes_reach_the_same_bits(home, arm):
    arm.log_batches(*range(4))
    arm.log_event("settings", forgetting_s=5.0)
    arm.log_batch(5, size=120)
    arm.log_batch(700, size=1, record=residual_record(0.3))
    arm.log_event("change", t=BEGIN + 20.0)
    arm.unlearn(6)
    arm.log_batch(90, rows=make_rows(1, size=600))
    first, second = (make_state_in_process(home, page_rows) for page_rows in (500, 1))
    assert first == second
    arm.store_snapshot(at_most=7)
    assert make_state_in_process(home, 500)[0] == first[0]
