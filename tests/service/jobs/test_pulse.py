"""A training process's talk with the database, which goes on whatever the fit does; the remaining time of a fit."""

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
from tests.service.jobs.conftest import new_row


@pytest.fixture
def beating(home, monkeypatch):
    """A database with a running job, and a pulse of it that beats quickly."""
    monkeypatch.setattr(pulse, "BEAT_S", 0.01)
    database = Database.of(Settings(home=home))
    with database.transaction() as session:
        session.add(new_row("x", state="running", attempts=1))
    with Heartbeat(database, own, "arm") as talk:
        yield database, talk
    database.close()


def own(session):
    found = session.scalar(select(JobRow).where(JobRow.id == "job_x"))
    if found.attempts != 1:
        raise SupersededError
    return found


def row(database):
    with database.session() as session:
        return own(session)


def change(database, **values):
    with database.transaction() as session:
        found = session.scalar(select(JobRow).where(JobRow.id == "job_x"))
        for name, value in values.items():
            setattr(found, name, value)


def test_progress_is_written_without_the_fit_waiting_for_it(beating):
    database, talk = beating
    with database.transaction():  # nobody else can write: the fit does not notice
        talk.progress(FitProgress("hyperparameters", 7, 50, -12.5, 0.133, 3.0))
        assert not talk.cancelled()
    seen = eventually(lambda: (found := row(database).progress).get("iteration") and found)
    assert {name: seen[name] for name in ("stage", "max_iterations", "objective", "fraction", "remaining_s")} == {
        "stage": "hyperparameters",
        "max_iterations": 50,
        "objective": -12.5,
        "fraction": 0.133,
        "remaining_s": None,
    }


def test_a_database_that_fails_for_a_while_stops_nothing(beating, monkeypatch, caplog):
    database, talk = beating
    transaction, failures = database.transaction, iter([OperationalError("BEGIN", {}, Exception("locked"))] * 2)

    @contextmanager
    def sometimes(model: str | None = None):
        for failure in failures:
            raise failure
        with transaction(model) as session:
            yield session

    monkeypatch.setattr(database, "transaction", sometimes)
    eventually(lambda: len(caplog.records) == 2)
    before = row(database).heartbeat_at
    eventually(lambda: row(database).heartbeat_at != before)
    assert not talk.cancelled()


def test_work_that_hangs_has_no_pulse(beating, monkeypatch, caplog):
    """The thread that beats lives on; what counts is whether the work does."""
    database, talk = beating
    eventually(lambda: row(database).heartbeat_at)
    monkeypatch.setattr(talk._progress, "look", lambda: "it has not got on for 60 s")
    eventually(lambda: "no signs of life are given any more: it has not got on for 60 s" in caplog.text)
    before = row(database).heartbeat_at
    change(database, cancel_requested=True)
    eventually(talk.cancelled)  # it has beaten, or tried to
    assert row(database).heartbeat_at == before
    monkeypatch.undo()
    eventually(lambda: row(database).heartbeat_at != before)


def test_nothing_is_written_after_the_end(beating):
    database, talk = beating
    eventually(lambda: row(database).heartbeat_at)
    talk.end()
    change(database, progress={"stage": "done"})
    talk.stage("saving")
    assert not talk._thread.is_alive()
    assert row(database).progress == {"stage": "done"}


def test_the_fraction_is_divided_by_how_long_fits_and_passes_take(beating):
    _, talk = beating
    talk.plan(200, 100, 100)
    for method, given, expected in (
        (talk.progress, FitProgress("posterior", 9, 9, -1.0, 1.0, 3.0), 0.5),
        (talk.share, 0.5, 0.625),
        (talk.share, 1.0, 0.75),
    ):
        method(given)
        assert talk.as_json()["fraction"] == pytest.approx(expected)
    talk.plan(20, 0)
    talk.stage(pulse.LAST_FIT)
    assert talk.as_json()["remaining_s"] is None
    talk.last_fit(FitProgress("hyperparameters", 2, 9, -5.0, 0.8, 3.0))
    seen = talk.as_json()
    assert seen["fraction"] == pytest.approx(0.75 + 0.8 * 0.25)
    assert (seen["stage"], seen["iteration"], seen["objective"]) == ("all_rows", 9, -1.0)


def at(iteration, stage="hyperparameters", most=50):
    return FitProgress(stage, iteration, most, 0.0, 0.95 * iteration / most, 0.0)


def test_it_is_not_told_before_the_pace_is_known():
    left = RemainingTime(100, 100)
    assert left.seconds(0.0) is None
    for iteration in (1, 2):
        left.step(at(iteration), 2.0 * iteration)
        assert left.seconds(2.0 * iteration) is None
    left.step(at(3), 6.0)
    assert left.seconds(6.0) is not None


@pytest.mark.parametrize("ratio", [1, 2, 4])
def test_a_steady_search_counts_down_to_the_end(ratio):
    """The steps that follow the search cost as the cube of their samples."""
    left, after = RemainingTime(100, 100 * ratio), PACE.posterior_iterations * ratio**3
    for iteration in range(1, 51):
        left.step(at(iteration), 10.0 + 2.0 * iteration)
        if iteration >= 3:
            assert left.seconds(10.0 + 2.0 * iteration) == pytest.approx(2.0 * (50 - iteration + after))
    left.step(at(50, "posterior"), 110.0)
    assert left.seconds(111.0) == pytest.approx(2.0 * after - 1.0)


def test_a_second_search_begins_anew():
    """As where an arm is learnt before the hyperparameters of what it leaves: both count from their own start."""
    left = RemainingTime(100, 100)
    for iteration in (3, 4, 5):
        left.step(at(iteration), 10.0 * iteration)
    for iteration in (1, 2, 3, 4):
        left.step(at(iteration), 60.0 + 2.0 * iteration)
    assert left.seconds(68.0) == pytest.approx(2.0 * (46 + PACE.posterior_iterations))


def test_the_time_that_is_left_of_several_fits_is_that_of_their_share():
    left = RemainingTime(100, 500)
    left.step(FitProgress("geometry", 1, 150, 0.0, PACE.min_fraction / 2, 1.0, "rigid-body"), 11.0)
    assert left.seconds(11.0) is None
    left.step(FitProgress("hyperparameters", 3, 150, 0.0, 0.25, 20.0, "lip-chain"), 30.0)
    assert left.seconds(30.0) == pytest.approx(60.0)


def test_what_was_told_too_low_is_no_longer_told():
    left = RemainingTime(100, 100)
    for iteration in range(1, 5):
        left.step(at(iteration), float(iteration))
    left.step(at(4, "posterior"), 4.0)
    assert left.seconds(4.0) == pytest.approx(PACE.posterior_iterations)
    assert left.seconds(4.0 + PACE.posterior_iterations) is None
