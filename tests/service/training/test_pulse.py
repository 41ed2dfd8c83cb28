"""The heartbeat of a training process, which never delays the fit, and the remaining time of a fit."""

import pytest
from sqlalchemy import select
from sqlalchemy.exc import OperationalError

from lipcore.estimators.hyperparameters import FitProgress
from service.storage.database import JobRow
from service.training import pulse
from service.training.pulse import PACE, Heartbeat, RemainingTime
from tests.service.data import eventually
from tests.service.training.conftest import fail_at_first

JOB = "job_x"


@pytest.fixture
def heartbeat(table, monkeypatch):
    """A frequent heartbeat of a running job of the table."""
    monkeypatch.setattr(pulse, "BEAT_S", 0.01)
    table.add("x", state="running", attempts=1)
    with Heartbeat(table.database, lambda session: session.scalar(select(JobRow)), "arm") as job_heartbeat:
        yield job_heartbeat


def wait_for_beat(table, before=None):
    """Wait for another heartbeat than `before`; return it."""
    return eventually(lambda: (beat := table.row(JOB).heartbeat_at) != before and beat)


def test_fit_does_not_wait_for_progress_to_be_written(table, heartbeat):
    with table.database.transaction():  # nobody else can write, and the fit does not wait
        heartbeat.progress(FitProgress("hyperparameters", 7, 50, -12.5, 0.133, 3.0))
        assert not heartbeat.cancelled()
    seen = eventually(lambda: (found := table.row(JOB).progress).get("iteration") and found)
    values = [seen[name] for name in ("stage", "max_iterations", "objective", "fraction", "remaining_s")]
    assert values == ["hyperparameters", 50, -12.5, 0.133, None]


def test_short_database_failure_stops_nothing(table, heartbeat, monkeypatch, caplog):
    failures = [OperationalError("BEGIN", {}, Exception("locked"))] * 2
    monkeypatch.setattr(table.database, "transaction", fail_at_first(table.database.transaction, *failures))
    eventually(lambda: len(caplog.records) == 2)
    wait_for_beat(table, table.row(JOB).heartbeat_at)
    assert not heartbeat.cancelled()


def test_hanging_work_has_no_heartbeat(table, heartbeat, monkeypatch, caplog):
    """The heartbeat's thread stays alive; only progress of the work counts."""
    wait_for_beat(table)
    monkeypatch.setattr(heartbeat._progress, "check", lambda: "it has made no progress for 60 s")
    eventually(lambda: "no more heartbeats are sent: it has made no progress for 60 s" in caplog.text)
    before = table.row(JOB).heartbeat_at
    table.change(JOB, cancel_requested=True)
    eventually(heartbeat.cancelled)  # the heartbeat was written, or its write was attempted
    assert table.row(JOB).heartbeat_at == before
    monkeypatch.undo()
    wait_for_beat(table, before)


def test_nothing_is_written_after_the_end(table, heartbeat):
    wait_for_beat(table)
    heartbeat.end()
    table.change(JOB, progress={"stage": "done"})
    heartbeat.stage("saving")
    assert not heartbeat._thread.is_alive()
    assert table.row(JOB).progress == {"stage": "done"}


def test_remaining_time_depends_on_typical_fit_and_pass_durations(heartbeat):
    heartbeat.plan(200, 100, 100)
    for method, given, expected in (
        (heartbeat.progress, FitProgress("posterior", 9, 9, -1.0, 1.0, 3.0), 0.5),
        (heartbeat.share, 0.5, 0.625),
        (heartbeat.share, 1.0, 0.75),
    ):
        method(given)
        assert heartbeat.as_json()["fraction"] == pytest.approx(expected)
    heartbeat.plan(20, 0)
    heartbeat.stage(pulse.LAST_FIT)
    assert heartbeat.as_json()["remaining_s"] is None
    heartbeat.last_fit(FitProgress("hyperparameters", 2, 9, -5.0, 0.8, 3.0))
    seen = heartbeat.as_json()
    assert seen["fraction"] == pytest.approx(0.75 + 0.8 * 0.25)
    assert (seen["stage"], seen["iteration"], seen["objective"]) == ("all_rows", 9, -1.0)


def at(iteration, stage="hyperparameters", max_iterations=50):
    return FitProgress(stage, iteration, max_iterations, 0.0, 0.95 * iteration / max_iterations, 0.0)


def timed_search(iterations, start_s, step_s, left=None):
    """Return the estimate after these iterations of a search whose steps take equally long."""
    left = RemainingTime(100, 100) if left is None else left
    for iteration in iterations:
        left.step(at(iteration), start_s + step_s * iteration)
    return left


def test_remaining_time_is_unknown_before_the_pace_is():
    assert timed_search([], 0.0, 2.0).seconds(0.0) is None
    assert timed_search([1], 0.0, 2.0).seconds(2.0) is None
    assert timed_search([1, 2], 0.0, 2.0).seconds(4.0) is None
    assert timed_search([1, 2, 3], 0.0, 2.0).seconds(6.0) is not None


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
    left = timed_search((1, 2, 3, 4), 60.0, 2.0, timed_search((3, 4, 5), 0.0, 10.0))
    assert left.seconds(68.0) == pytest.approx(2.0 * (46 + PACE.posterior_iterations))


def test_remaining_time_of_several_fits_is_that_of_their_share():
    left = RemainingTime(100, 500)
    left.step(FitProgress("geometry", 1, 150, 0.0, PACE.min_fraction / 2, 1.0, "rigid-body"), 11.0)
    assert left.seconds(11.0) is None
    left.step(FitProgress("hyperparameters", 3, 150, 0.0, 0.25, 20.0, "lip-chain"), 30.0)
    assert left.seconds(30.0) == pytest.approx(60.0)


def test_estimate_that_was_too_low_is_withdrawn():
    left = timed_search(range(1, 5), 0.0, 1.0)
    left.step(at(4, "posterior"), 4.0)
    assert left.seconds(4.0) == pytest.approx(PACE.posterior_iterations)
    assert left.seconds(4.0 + PACE.posterior_iterations) is None
