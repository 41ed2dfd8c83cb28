"""When a training process is ended and what becomes of its job, decided from rows and a clock without processes."""

import pytest

from service.foundation.settings import Settings
from service.storage.files import Files
from service.training import lifecycle
from service.training.lifecycle import JobEnd, JobOutcome, JobStatus, Settler, WatchedJob
from tests.service.training.conftest import new_row

SETTINGS = Settings(max_job_s=1000.0)


def verdict(looks, clock, stopped=None):
    """Return why a job watched since 100 s is ended at a time; looks: time and status of each look at its row."""
    given = WatchedJob("job_x", slot=None, future=None, since=100.0)
    for time, status in looks:
        given.update(status, time)
    if stopped is not None:
        given.stop(stopped)
    found = given.judge(SETTINGS, clock)
    return None if found is None else found.why


def running(heartbeat="a", cancel=False):
    return JobStatus("running", heartbeat, cancel)


CANCELS = [(101.0, running("a")), (110.0, running("b", True)), (110.9, running("c", True))]
"""The time to obey counts from the first."""
BEATS = [(101.0 + 50 * beat, running(f"1970-01-01T00:00:0{beat}")) for beat in range(5)]
"""Clocks of rows may be changed and machines sleep, so only a changed heartbeat matters."""
UNTIL_1101_S = [(float(clock), running(str(clock))) for clock in range(101, 1102, 50)]


@pytest.mark.parametrize(
    ("looks", "last_s", "end_s", "why"),
    [
        ([(150.0, JobStatus("queued", None, False))], 219.9, 220.0, "not_started"),
        *((BEATS[:count], 50 * count + 100.0, 50 * count + 171.0, "silent") for count in range(1, 6)),
        ([*BEATS, (340.0, BEATS[-1][1])], 360.9, 361.0, "silent"),
        (CANCELS, 110.99, 111.0, "cancelled"),
        (UNTIL_1101_S, 1100.9, 1101.0, "too_long"),
        *(
            ([(101.0, running()), (110.0, JobStatus(state, "a", True))], 119.9, 120.0, "lingering")
            for state in ("succeeded", "failed", "cancelled")
        ),
    ],
)
def test_process_is_ended_at_its_limit(looks, last_s, end_s, why):
    assert verdict(looks, last_s) is None
    assert verdict(looks, end_s) == why


def test_cancel_before_the_process_begins_ends_nothing():
    """The row of such a job is cancelled already, so the process would do nothing."""
    assert verdict([], 110.0, stopped=101.0) is None


def settle(table, home, why="ended", message="the training process ended", **values):
    """Settle a job that has these values; return the outcome and the row."""
    job = table.add("x", **{"state": "running", "attempts": 1, **values})
    return Settler(table.database, Files(home)).settle(JobEnd(job, why, message)), table.row(job)


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
def test_outcome_of_a_running_job(table, home, values, settled, state, code):
    found, row = settle(table, home, **values)
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
def test_job_that_does_not_run_is_unchanged(table, home, values, settled):
    found, row = settle(table, home, **values)
    assert (found, row.state, row.finished_at, row.history) == (settled, values["state"], values.get("finished_at"), [])


def test_missing_job_has_no_outcome(table, home):
    assert Settler(table.database, Files(home)).settle(JobEnd("job_y", "ended", "")) == JobOutcome()


def test_only_unpublished_files_of_a_job_are_deleted(table, home):
    files = Files(home)
    own, others = lifecycle.new_folder("job_x1x"), lifecycle.new_folder("job_y2y")
    for name in (own, others, f".draft-{own}-abc", "mv_published"):
        (files.versions / name).mkdir()
    assert lifecycle.remove_leftovers(table.database, files, "job_x1x") == 2
    assert {path.name for path in files.versions.iterdir()} == {others, "mv_published"}
    assert lifecycle.remove_leftovers(table.database, files, "job_x1x") == 0


def test_history_keeps_its_first_and_newest_entries():
    row = new_row("x")
    for number in range(lifecycle.MAX_ENTRIES + 5):
        lifecycle.enter(row, "queued", str(number))
    messages = [entry["message"] for entry in row.history]
    assert len(messages) == lifecycle.MAX_ENTRIES
    assert (messages[0], messages[1], messages[-1]) == ("0", "6", str(lifecycle.MAX_ENTRIES + 4))
