"""The heartbeat of a training process, which never delays the fit, and the remaining time of a fit."""

from contextlib import contextmanager

import pytest
from sqlalchemy import select
from sqlalchemy.exc import OperationalError

from lipcore.estimators.hyperparameters import FitProgress
from service.foundation.settings import Settings
from service.storage.database import Database, JobRow
from service.training import pulse
from service.training.pulse import PACE, Heartbeat, RemainingTime, SupersededError
from tests.service.data import eventually
from tests.service.training.conftest import new_row


@pytest.fixture
def heartbeat(home, monkeypatch):
    """A database with a running job, and a frequent heartbeat of it."""
    monkeypatch.setattr(pulse, "BEAT_S", 0.01)
    database = Database.of(Settings(home=home))
    with database.transaction() as session:
        session.add(new_row("x", state="running", attempts=1))
    with Heartbeat(database, own_row, "arm") as job_heartbeat:
        yield database, job_heartbeat
    database.close()


def own_row(session):
    found = session.scalar(select(JobRow).where(JobRow.id == "job_x"))
    if found.attempts != 1:
        raise SupersededError
    return found


def row(database):
    with database.session() as session:
        return own_row(session)


def change(database, **values):
    with database.transaction() as session:
        found = session.scalar(select(JobRow).where(JobRow.id == "job_x"))
        for name, value in values.items():
            setattr(found, name, value)


def test_fit_does_not_wait_for_progress_to_be_written(heartbeat):
    database, job_heartbeat = heartbeat
    with database.transaction():  # nobody else can write, and the fit does not wait
        job_heartbeat.progress(FitProgress("hyperparameters", 7, 50, -12.5, 0.133, 3.0))
        assert not job_heartbeat.cancelled()
    seen = eventually(lambda: (found := row(database).progress).get("iteration") and found)
    assert {name: seen[name] for name in ("stage", "max_iterations", "objective", "fraction", "remaining_s")} == {
        "stage": "hyperparameters",
        "max_iterations": 50,
        "objective": -12.5,
        "fraction": 0.133,
        "remaining_s": None,
    }


def test_short_database_failure_stops_nothing(heartbeat, monkeypatch, caplog):
    database, job_heartbeat = heartbeat
    transaction, failures = database.transaction, iter([OperationalError("BEGIN", {}, Exception("locked"))] * 2)

    @contextmanager
    def fail_twice(model: str | None = None):
        for failure in failures:
            raise failure
        with transaction(model) as session:
            yield session

    monkeypatch.setattr(database, "transaction", fail_twice)
    eventually(lambda: len(caplog.records) == 2)
    before = row(database).heartbeat_at
    eventually(lambda: row(database).heartbeat_at != before)
    assert not job_heartbeat.cancelled()


def test_hanging_work_has_no_heartbeat(heartbeat, monkeypatch, caplog):
    """The heartbeat's thread stays alive; only progress of the work counts."""
    database, job_heartbeat = heartbeat
    eventually(lambda: row(database).heartbeat_at)
    monkeypatch.setattr(job_heartbeat._progress, "look", lambda: "it has made no progress for 60 s")
    eventually(lambda: "no more heartbeats are sent: it has made no progress for 60 s" in caplog.text)
    before = row(database).heartbeat_at
    change(database, cancel_requested=True)
    eventually(job_heartbeat.cancelled)  # the heartbeat was written, or its write was attempted
    assert row(database).heartbeat_at == before
    monkeypatch.undo()
    eventually(lambda: row(database).heartbeat_at != before)


def test_nothing_is_written_after_the_end(heartbeat):
    database, job_heartbeat = heartbeat
    eventually(lambda: row(database).heartbeat_at)
    job_heartbeat.end()
    change(database, progress={"stage": "done"})
    job_heartbeat.stage("saving")
    assert not job_heartbeat._thread.is_alive()
    assert row(database).progress == {"stage": "done"}


def test_remaining_time_depends_on_typical_fit_and_pass_durations(heartbeat):
    _, job_heartbeat = heartbeat
    job_heartbeat.plan(200, 100, 100)
    for method, given, expected in (
        (job_heartbeat.progress, FitProgress("posterior", 9, 9, -1.0, 1.0, 3.0), 0.5),
        (job_heartbeat.share, 0.5, 0.625),
        (job_heartbeat.share, 1.0, 0.75),
    ):
        method(given)
        assert job_heartbeat.as_json()["fraction"] == pytest.approx(expected)
    job_heartbeat.plan(20, 0)
    job_heartbeat.stage(pulse.LAST_FIT)
    assert job_heartbeat.as_json()["remaining_s"] is None
    job_heartbeat.last_fit(FitProgress("hyperparameters", 2, 9, -5.0, 0.8, 3.0))
    seen = job_heartbeat.as_json()
    assert seen["fraction"] == pytest.approx(0.75 + 0.8 * 0.25)
    assert (seen["stage"], seen["iteration"], seen["objective"]) == ("all_rows", 9, -1.0)


def at(iteration, stage="hyperparameters", max_iterations=50):
    return FitProgress(stage, iteration, max_iterations, 0.0, 0.95 * iteration / max_iterations, 0.0)


def test_remaining_time_is_unknown_before_the_pace_is():
    left = RemainingTime(100, 100)
    assert left.seconds(0.0) is None
    for iteration in (1, 2):
        left.step(at(iteration), 2.0 * iteration)
        assert left.seconds(2.0 * iteration) is None
    left.step(at(3), 6.0)
    assert left.seconds(6.0) is not None


@pytest.mark.parametrize("ratio", [1, 2, 4])
def test_steady_search_counts_down_to_the_end(ratio):
    """The time of the steps after the search grows with the cube of their samples."""
    left, after = RemainingTime(100, 100 * ratio), PACE.posterior_iterations * ratio**3
    for iteration in range(1, 51):
        left.step(at(iteration), 10.0 + 2.0 * iteration)
        if iteration >= 3:
            assert left.seconds(10.0 + 2.0 * iteration) == pytest.approx(2.0 * (50 - iteration + after))
    left.step(at(50, "posterior"), 110.0)
    assert left.seconds(111.0) == pytest.approx(2.0 * after - 1.0)


def test_second_search_starts_a_new_estimate():
    """First the arm is learnt, then the hyperparameters of the residual; each is timed from its own start."""
    left = RemainingTime(100, 100)
    for iteration in (3, 4, 5):
        left.step(at(iteration), 10.0 * iteration)
    for iteration in (1, 2, 3, 4):
        left.step(at(iteration), 60.0 + 2.0 * iteration)
    assert left.seconds(68.0) == pytest.approx(2.0 * (46 + PACE.posterior_iterations))


def test_remaining_time_of_several_fits_is_that_of_their_share():
    left = RemainingTime(100, 500)
    left.step(FitProgress("geometry", 1, 150, 0.0, PACE.min_fraction / 2, 1.0, "rigid-body"), 11.0)
    assert left.seconds(11.0) is None
    left.step(FitProgress("hyperparameters", 3, 150, 0.0, 0.25, 20.0, "lip-chain"), 30.0)
    assert left.seconds(30.0) == pytest.approx(60.0)


def test_estimate_that_was_too_low_is_withdrawn():
    left = RemainingTime(100, 100)
    for iteration in range(1, 5):
        left.step(at(iteration), float(iteration))
    left.step(at(4, "posterior"), 4.0)
    assert left.seconds(4.0) == pytest.approx(PACE.posterior_iterations)
    assert left.seconds(4.0 + PACE.posterior_iterations) is None
