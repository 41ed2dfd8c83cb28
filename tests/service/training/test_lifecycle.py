"""When a training process is ended and what becomes of its job, decided from rows and a clock without processes."""

import pytest
from sqlalchemy import select

from service.foundation.settings import Settings
from service.storage.database import Database, JobRow
from service.storage.files import Files
from service.training import lifecycle
from service.training.lifecycle import LIMITS, JobEnd, JobOutcome, JobStatus, Settler, WatchedJob
from tests.service.training.conftest import new_row

SETTINGS = Settings(max_job_s=1000.0)


def watched_job():
    return WatchedJob("job_x", slot=None, future=None, since=100.0)


def status(state="running", heartbeat="a", cancel=False):
    return JobStatus(state, heartbeat, cancel)


def verdict(given, clock):
    found = given.judge(SETTINGS, clock)
    return None if found is None else found.why


def test_process_may_take_its_time_to_start():
    given = watched_job()
    given.see(status("queued", None), 150.0)
    assert verdict(given, 219.9) is None
    assert verdict(given, 220.0) == "not_started"


def test_change_of_the_heartbeat_counts_not_its_value():
    """Clocks of rows may be changed and machines sleep, so only a changed heartbeat matters."""
    given = watched_job()
    for beat in range(5):
        clock = 101.0 + 50 * beat
        given.see(status(heartbeat=f"1970-01-01T00:00:0{beat}"), clock)
        assert verdict(given, clock + 49) is None
    given.see(status(heartbeat="1970-01-01T00:00:04"), 340.0)
    assert verdict(given, 360.9) is None
    assert verdict(given, 361.0) == "silent"


def test_time_to_obey_a_cancel_counts_from_its_detection():
    given = watched_job()
    given.see(status(), 101.0)
    given.see(status(heartbeat="b", cancel=True), 110.0)
    given.see(status(heartbeat="c", cancel=True), 110.9)
    assert verdict(given, 110.99) is None
    assert verdict(given, 111.0) == "cancelled"


def test_cancel_before_the_process_begins_ends_nothing():
    """The row of such a job is cancelled already, so the process would do nothing."""
    given = watched_job()
    given.stop(101.0)
    assert verdict(given, 110.0) is None


def test_job_has_a_maximum_duration():
    given = watched_job()
    for clock in range(101, 1102, 50):
        given.see(status(heartbeat=str(clock)), float(clock))
    assert verdict(given, 1100.9) is None
    assert verdict(given, 1101.0) == "too_long"


@pytest.mark.parametrize("state", ["succeeded", "failed", "cancelled"])
def test_process_that_continues_after_its_job_is_ended(state):
    given = watched_job()
    given.see(status(), 101.0)
    given.see(status(state, cancel=True), 110.0)
    assert verdict(given, 110.0 + LIMITS.linger_s - 0.1) is None
    assert verdict(given, 110.0 + LIMITS.linger_s) == "lingering"


@pytest.fixture
def store(home):
    database = Database(home)
    yield database, Files(home)
    database.close()


def settle(store, why="ended", message="the training process ended", **values):
    """Settle a job that has these values; return the outcome and the row."""
    database, files = store
    with database.transaction() as session:
        session.add(new_row("x", **{"state": "running", "attempts": 1, **values}))
    settled = Settler(database, files).settle(JobEnd("job_x", why, message))
    with database.session() as session:
        return settled, session.scalar(select(JobRow).where(JobRow.id == "job_x"))


@pytest.mark.parametrize(
    ("values", "settled", "state", "code"),
    [
        ({}, JobOutcome(again=True), "queued", None),
        ({"attempts": 3}, JobOutcome(), "failed", "interrupted"),
        ({"why": "too_long"}, JobOutcome(), "failed", "too_long"),
        ({"why": "cancelled"}, JobOutcome(), "cancelled", None),
        ({"cancel_requested": True}, JobOutcome(), "cancelled", None),
        ({"why": "too_long", "cancel_requested": True}, JobOutcome(), "cancelled", None),
    ],
)
def test_outcome_of_a_running_job(store, values, settled, state, code):
    found, row = settle(store, **values)
    assert (found, row.state, row.error and row.error["code"]) == (settled, state, code)
    last = row.history[-1]
    assert "the training process ended" in last["message"]
    assert state == "queued" or row.finished_at == last["at"]
    assert state != "queued" or (row.progress, last["message"][-14:]) == ({"stage": "waiting"}, ": queued again")


@pytest.mark.parametrize(
    ("values", "settled"),
    [
        ({"state": "succeeded", "version": 3}, JobOutcome(made=("x", 3))),  # before its process died
        ({"why": "cancelled", "state": "failed", "finished_at": "then"}, JobOutcome()),
        ({"why": "cancelled", "state": "cancelled", "finished_at": "then"}, JobOutcome()),
        ({"why": "returned", "state": "queued"}, JobOutcome(again=True)),  # meanwhile, and no attempt is counted
    ],
)
def test_job_that_does_not_run_is_unchanged(store, values, settled):
    found, row = settle(store, **values)
    assert (found, row.state, row.finished_at, row.history) == (settled, values["state"], values.get("finished_at"), [])


def test_missing_job_has_no_outcome(store):
    database, files = store
    assert Settler(database, files).settle(JobEnd("job_y", "ended", "")) == JobOutcome()


def test_only_unpublished_files_of_a_job_are_deleted(store):
    database, files = store
    own, others = lifecycle.new_folder("job_x1x"), lifecycle.new_folder("job_y2y")
    for name in (own, others, f".draft-{own}-abc", "mv_published"):
        (files.versions / name).mkdir()
    assert lifecycle.remove_leftovers(database, files, "job_x1x") == 2
    assert {path.name for path in files.versions.iterdir()} == {others, "mv_published"}
    assert lifecycle.remove_leftovers(database, files, "job_x1x") == 0


def test_history_keeps_its_first_and_newest_entries():
    row = new_row("x")
    for number in range(lifecycle.MAX_ENTRIES + 5):
        lifecycle.enter(row, "queued", str(number))
    messages = [entry["message"] for entry in row.history]
    assert len(messages) == lifecycle.MAX_ENTRIES
    assert (messages[0], messages[1], messages[-1]) == ("0", "6", str(lifecycle.MAX_ENTRIES + 4))
