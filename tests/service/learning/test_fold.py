"""The state after an event is a function of the log up to it, to the last bit: whoever makes it, when and how."""

import hashlib
import multiprocessing
import tempfile
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from sqlalchemy import delete
from threadpoolctl import threadpool_limits

import lipcore
from lipcore.online import transfer
from lipcore.online.transfer import Revision
from service.journal import log, snapshots
from service.journal import restore as restoring
from service.journal.floor import error_floor_of
from service.journal.restore import advance, restore
from service.models import registry
from service.storage.database import Database, SnapshotRow
from service.storage.files import Files
from tests.service.learning.folding import Fold
from tests.service.learning.pendulums import ARM, BEGIN, Arm, record, rows, trained

SIZE = 3
"""Rows of a batch."""

what = st.one_of(
    st.tuples(st.just("batch"), st.integers(0, 30)),
    st.tuples(st.just("batch"), st.integers(0, 30)),
    st.tuples(st.sampled_from(["replay", "unlearn", "unlearn", "rollback"]), st.integers(0, 100)),
    st.tuples(st.just("change"), st.integers(0, 30)),
    st.tuples(st.just("settings"), st.sampled_from([None, 0.5, 2.0])),
    st.tuples(st.just("walk"), st.sampled_from([None, 2.0])),
)
piece = st.tuples(
    st.lists(what, min_size=1, max_size=8),  # what is logged
    st.integers(0, 4),  # pages that are learnt then
    st.booleans(),  # whether a snapshot is stored then
)


class Story:
    """A log that grows, and those who follow it; each state of theirs is checked against the definition."""

    def __init__(self, home: Path, start: int) -> None:
        self.arm, self.start, self.version = Arm.open(home), start, 1
        self.base = trained()
        self.sequence = 0
        self.dead: set[int] = set()

    def log(self, kind: str, value: int | float | None) -> None:
        """Log an event of a kind, about what `value` chooses."""
        arm = self.arm
        with arm.database.session() as session:
            events = log.events(session, ARM, 0, 1000, void=True)
        batches = [each.number for each in events if each.kind == "batch"]
        if kind == "batch":
            arm.batch(self.sequence, rows=rows(int(value), SIZE), received=BEGIN + value / 10)
            self.sequence += 1
        elif kind == "change":
            arm.event("change", t=BEGIN + value / 30)
        elif kind == "settings":
            arm.event("settings", forgetting_s=value)
        elif kind == "walk":
            arm.event("settings", forgetting_s=None, friction_walk_s=value)
        elif kind == "rollback":
            free = [each for each in range(len(events)) if each not in self.dead]
            if len(events) > 1:
                to = free[int(value) % len(free)]
                self.dead |= set(range(to + 1, len(events) + 1))
                arm.rollback(to)
        elif batches:
            batch = batches[int(value) % len(batches)]
            if kind == "unlearn":
                arm.unlearn(batch)
            elif not arm.find(batch).void:
                arm.event("replay", rows(40 + int(value) % 20, SIZE), event=batch, codes=["contact"])

    def fold(self) -> Fold:
        """The definition."""
        with self.arm.database.session() as session:
            return Fold(self.base, log.events(session, ARM, 0, 1000, void=True), self.start)

    def begun(self):
        """A state to go on from."""
        return restore(self.arm.database, self.arm.files, ARM, self.version, self.base, pages=0)

    def followed(self, known, pages: int | None, fold: Fold):
        """Learn some pages, or all; check every state."""
        while pages is None or pages > 0:
            following = advance(self.arm.database, self.arm.files, known)
            if following is known:
                return known
            known, pages = following, pages and pages - 1
            assert transfer.dump(known.online) == transfer.dump(fold.after(known.number)), known.number
        return known

    def store(self, known) -> None:
        """Store a snapshot."""
        if known.number > self.start:
            payload = transfer.dump(known.online)
            place = ARM, self.version, known.number, known.seen
            snapshots.save(self.arm.database, self.arm.files, *place, payload, most=4)


def tell(pieces, page_rows: int, start: int) -> None:
    """Let a log grow piece by piece while it is followed, and others begin late."""
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(restoring, "PAGE_ROWS", page_rows)
        story = Story(Path(folder), 0)
        for number in range(start):
            story.log("settings" if number == 1 else "batch", 2.0 if number == 1 else number)
        if start:
            story.version, story.start = story.arm.publish(candidate=True, start=start), start
        known = story.begun()
        for events, pages, stored in pieces:
            for kind, value in events:
                story.log(kind, value)
            known = story.followed(known, pages, story.fold())
            if stored:
                story.store(known)
        fold = story.fold()
        known = story.followed(known, None, fold)
        late = story.followed(story.begun(), None, fold)
        assert known.number == late.number == len(fold.events)
        patch.setattr(restoring, "PAGE_ROWS", 500)
        with story.arm.database.transaction() as session:
            session.execute(delete(SnapshotRow))
        first = story.followed(story.begun(), None, fold)
        assert transfer.dump(known.online) == transfer.dump(late.online) == transfer.dump(first.online)
        story.arm.database.close()


TWO_CHANGES = [("batch", 0), ("change", 3), ("batch", 5), ("change", 20), ("batch", 9)]
TWICE = [("batch", 0), ("unlearn", 0), ("unlearn", 0), ("batch", 2), ("rollback", 3), ("batch", 3), ("rollback", 1)]
DRIFTING = [("walk", 2.0), *(("batch", at) for at in (0, 1, 30, 8, 12, 16, 2, 20))]
REWEIGHED = [("batch", 1), ("settings", 2.0), ("batch", 2)]


@settings(max_examples=12, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(st.lists(piece, min_size=1, max_size=4), st.sampled_from([1, 6, 500]), st.sampled_from([0, 0, 4]))
@example([(TWO_CHANGES, 2, True), ([("unlearn", 0), ("batch", 11)], 9, False)], 3, 0)
@example([(TWO_CHANGES, 3, True), ([("unlearn", 0), ("unlearn", 1), ("batch", 11), ("rollback", 3)], 3, True)], 3, 0)
@example([(TWICE, 9, True)], 500, 0)
@example([(DRIFTING, 3, True), ([("unlearn", 0), ("unlearn", 7), ("walk", None), ("rollback", 5)], 9, True)], 6, 0)
@example([(REWEIGHED, 9, False), ([("unlearn", 0), ("rollback", 3)], 9, True)], 3, 0)
def test_the_state_is_a_function_of_the_log_to_the_last_bit(pieces, page_rows, start):
    tell(pieces, page_rows, start)


@pytest.mark.slow
@settings(max_examples=400, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.lists(piece, min_size=2, max_size=8), st.sampled_from([1, 4, 6, 500]), st.sampled_from([0, 0, 4]))
def test_long_logs_too(pieces, page_rows, start):
    tell(pieces, page_rows, start)


def make(home: Path, page_rows: int, connection) -> None:
    """Make the state of a log in a process, and send a digest of it and of the answers that are solved from it."""
    threadpool_limits(1)
    restoring.PAGE_ROWS = page_rows
    database, files = Database(home), Files(home)
    base = lipcore.load(files.version_folder(registry.find(database, ARM, 1).folder))
    known = restore(database, files, ARM, 1, base)
    floor = error_floor_of(database, ARM, 1, known.number, 2)
    revision = Revision.of(known.online.model(floor))
    arrays = [getattr(revision, each.name) for each in fields(revision)]
    made = [transfer.dump(known.online), *(np.ascontiguousarray(each).tobytes() for each in arrays)]
    connection.send([hashlib.sha256(each).hexdigest() for each in made])
    database.close()


@pytest.mark.slow
def test_two_processes_reach_the_same_bits(home):
    arm = Arm.open(home)
    arm.batches(*range(4))
    arm.event("settings", forgetting_s=5.0)
    arm.batch(5, size=120)
    arm.batch(700, size=1, record=record(0.3))
    arm.event("change", t=BEGIN + 20.0)
    arm.unlearn(6)
    arm.batch(90, rows=rows(1, size=600))
    first, second = (_made(home, page_rows) for page_rows in (500, 1))
    assert first == second
    known = arm.restored(at_most=7)
    payload = transfer.dump(known.online)
    assert snapshots.save(arm.database, arm.files, ARM, 1, known.number, known.seen, payload, most=4) is not None
    assert _made(home, 500)[0] == first[0]
    arm.database.close()


def _made(home: Path, page_rows: int) -> list[str]:
    processes = multiprocessing.get_context("spawn")
    ours, theirs = processes.Pipe(duplex=False)
    process = processes.Process(target=make, args=(home, page_rows, theirs), daemon=True)
    process.start()
    theirs.close()
    found = ours.recv()
    process.join()
    return found
