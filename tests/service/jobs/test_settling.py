"""What becomes of a job whose process no longer runs it, and what its history says."""

from __future__ import annotations

import pytest
from sqlalchemy import select

from service.foundation.settings import Settings
from service.storage.database import Database, JobRow
from service.storage.files import Files
from service.training import lifecycle
from service.training.lifecycle import Ended, Settled, Settler
from tests.service.jobs.conftest import new_row


@pytest.fixture
def store(home):
    database = Database(home)
    yield database, Files(home)
    database.close()


def settle(store, why="ended", message="the training process ended", **values):
    """Settle a job that has these values; what becomes of it, and its row."""
    database, files = store
    with database.transaction() as session:
        session.add(new_row("x", **{"state": "running", "attempts": 1, **values}))
    settled = Settler(Settings(home=files.versions.parent, max_job_attempts=2), database, files).settle(
        Ended("job_x", why, message)
    )
    with database.session() as session:
        return settled, session.scalar(select(JobRow).where(JobRow.id == "job_x"))


def test_an_interrupted_job_waits_again(store):
    settled, row = settle(store)
    assert (settled, row.state, row.progress) == (Settled(again=True), "queued", {"stage": "waiting"})
    assert row.history[-1]["message"] == "the training process ended: queued again"


def test_one_that_was_tried_often_enough_fails(store):
    settled, row = settle(store, attempts=2)
    assert (settled, row.state, row.error["code"]) == (Settled(), "failed", "interrupted")
    assert row.history[-1]["message"] == row.error["message"]


@pytest.mark.parametrize(
    "values", [{"why": "cancelled"}, {"cancel_requested": True}, {"why": "too_long", "cancel_requested": True}]
)
def test_one_that_was_to_end_is_cancelled(store, values):
    settled, row = settle(store, **values)
    assert (settled, row.state, row.error) == (Settled(), "cancelled", None)
    assert row.finished_at == row.history[-1]["at"]


def test_one_that_ran_for_too_long_fails_at_once(store):
    settled, row = settle(store, "too_long", "it ran for 5 s")
    assert (settled, row.state, row.error) == (Settled(), "failed", {"code": "too_long", "message": "it ran for 5 s"})


def test_one_that_succeeded_before_its_process_died_has_made_its_version(store):
    settled, row = settle(store, state="succeeded", version=3)
    assert (settled, row.history) == (Settled(made=("x", 3)), [])


@pytest.mark.parametrize("state", ["failed", "cancelled"])
def test_one_that_has_ended_stays_as_it_is(store, state):
    settled, row = settle(store, "cancelled", state=state, finished_at="then")
    assert (settled, row.state, row.finished_at, row.history) == (Settled(), state, "then", [])


def test_one_that_was_queued_again_meanwhile_is_handed_out_again_without_blame(store):
    assert settle(store, "returned", state="queued")[0] == Settled(again=True)


def test_one_that_is_not_there_is_nobody_s(store):
    database, files = store
    assert (
        Settler(Settings(home=files.versions.parent), database, files).settle(Ended("job_y", "ended", "")) == Settled()
    )


def test_what_a_job_did_not_publish_is_deleted_and_nothing_else(store):
    database, files = store
    own, others = lifecycle.new_folder("job_x1x"), lifecycle.new_folder("job_y2y")
    for name in (own, others, f".draft-{own}-abc", "mv_published"):
        (files.versions / name).mkdir()
    assert lifecycle.remove_leftovers(database, files, "job_x1x") == 2
    assert {path.name for path in files.versions.iterdir()} == {others, "mv_published"}
    assert lifecycle.remove_leftovers(database, files, "job_x1x") == 0


def test_a_history_keeps_its_first_and_its_newest_entries():
    row = new_row("x")
    for number in range(lifecycle.MOST_ENTRIES + 5):
        lifecycle.enter(row, "queued", str(number))
    messages = [entry["message"] for entry in row.history]
    assert len(messages) == lifecycle.MOST_ENTRIES
    assert (messages[0], messages[1], messages[-1]) == ("0", "6", str(lifecycle.MOST_ENTRIES + 4))
