"""The job queue with processes that hang, die or ignore cancels: every job ends or is resumed."""

from unittest.mock import Mock

from service.storage import replicas
from service.training import metrics, queue
from service.training.lifecycle import JobLimits
from tests.service.data import eventually
from tests.service.server import command
from tests.service.training import workers
from tests.service.training.conftest import fail_at_first, messages_of


def test_only_the_process_that_ignores_a_cancel_is_ended(start_queue):
    jobs = start_queue(workers.ignore_cancel, JobLimits(cancel_s=0.1), training_workers=2)
    stubborn, other = jobs.submit("stubborn"), jobs.submit("other")
    first, beside = jobs.running(stubborn), jobs.running(other)
    jobs.change(stubborn, cancel_requested=True)
    seen = jobs.ended(stubborn)
    assert (seen.state, seen.version, seen.attempts) == ("cancelled", None, 1)
    assert "did not stop within 0.1 s" in messages_of(seen)[-1]
    assert seen.finished_at
    eventually(lambda: command(first.progress["process"]) == "")

    still = jobs.row(other)
    assert (still.state, still.attempts, still.progress) == ("running", 1, beside.progress)
    assert command(still.progress["process"])


def test_cancel_ends_a_suspended_process_that_holds_the_lock(start_queue):
    jobs = start_queue(workers.suspend_self_with_lock, JobLimits(cancel_s=0.1))
    job = jobs.submit("locked")
    eventually((jobs.settings.home / "locked").exists)
    jobs.running(job)  # reading needs no lock
    eventually(lambda: jobs.queue._watched_jobs[0].ran)
    jobs.queue.stop(job)  # the service ends the process first, as writing the request would have to wait
    assert jobs.ended(job).state == "cancelled"


def test_process_without_heartbeat_is_restarted_a_few_times(start_queue):
    jobs = start_queue(workers.suspend_self, JobLimits(heartbeat_s=0.3, attempts=2))
    seen = jobs.ended(jobs.submit("frozen"))
    assert (seen.state, seen.attempts, seen.error["code"]) == ("failed", 2, "interrupted")
    silent = "the training process made no progress for 0.3 s and was killed"
    assert messages_of(seen)[:3] == ["started", f"{silent}: queued again", "started"]
    assert seen.error["message"].startswith(silent)
    assert "2 times" in seen.error["message"]


def test_silent_process_is_reported(start_queue, monkeypatch):
    jobs = start_queue(workers.suspend_self, JobLimits(heartbeat_s=1000.0))
    jobs.running(jobs.submit("frozen"))
    monkeypatch.setattr(metrics, "SILENT_S", 0.1)
    seen = eventually(lambda: (now := metrics.check_queue(jobs.queue, lambda wrong: None))[0] == "warning" and now)
    assert seen[1].startswith("0 jobs waiting, 1 running; a training process has made no progress for ")


def test_job_whose_process_cannot_start_fails(start_queue):
    jobs = start_queue(workers.exit_before_start, JobLimits(attempts=2, pause_s=0.05))
    seen = jobs.ended(jobs.submit("stillborn"))
    assert (seen.state, seen.attempts, seen.error["code"]) == ("failed", 0, "interrupted")
    assert "exit code 3" in seen.error["message"]
    assert "2 starts have failed" in seen.error["message"]
    assert "exit code 3" in jobs.queue.problem


def test_job_waits_while_no_process_can_be_started(start_queue, monkeypatch):
    jobs = start_queue(workers.succeed, JobLimits(pause_s=0.05))
    (slot,) = jobs.queue._slots
    refusal = OSError(11, "Resource temporarily unavailable")
    monkeypatch.setattr(slot, "start", fail_at_first(slot.start, refusal))
    seen = jobs.ended(jobs.submit("patient"))
    assert (seen.state, seen.attempts) == ("succeeded", 1)
    assert "temporarily unavailable: queued again" in messages_of(seen)[0]


def test_outcome_is_written_once_the_database_is_unlocked(start_queue, monkeypatch):
    """The job's process dies while another program locks the database for longer than the service waits."""
    monkeypatch.setattr(queue, "RETRY_S", 0.05)
    jobs = start_queue(workers.exit_in_first_attempt)
    settle = Mock(wraps=jobs.queue._settler.settle)
    monkeypatch.setattr(jobs.queue._settler, "settle", settle)
    job = jobs.submit("frail")
    jobs.running(job)
    eventually(lambda: any((jobs.settings.home / "versions").iterdir()))
    with jobs.database.transaction():
        (jobs.settings.home / "die").touch()
        eventually(lambda: settle.call_count >= 2)
        assert jobs.row(job).state == "running"
    seen = jobs.ended(job)
    assert (seen.state, seen.attempts) == ("succeeded", 2)
    died = [message for message in messages_of(seen) if message.startswith("the training process ended with exit code")]
    assert [message.partition(": ")[2] for message in died] == ["queued again"]
    assert list((jobs.settings.home / "versions").iterdir()) == []  # its unfinished draft
    eventually(lambda: jobs.made == [("frail", 1)])


def test_jobs_without_an_owner_are_found(start_queue, monkeypatch):
    monkeypatch.setattr(replicas, "RECONCILE_S", 0.05)
    jobs = start_queue(workers.succeed, JobLimits(heartbeat_s=30))
    forgotten = jobs.add("forgotten")
    orphan = jobs.add("orphan", state="running", attempts=1, heartbeat_at="2020-01-01T00:00:00.000+00:00")
    assert jobs.ended(forgotten).state == "succeeded"
    seen = jobs.ended(orphan)
    assert (seen.state, seen.attempts) == ("succeeded", 2)
    assert messages_of(seen)[0] == "no process runs the job: queued again"


def test_jobs_start_once_and_in_order(start_queue, monkeypatch):
    jobs = start_queue(workers.succeed)
    names = [jobs.add(f"number{number}") for number in range(3)]
    for job in (*names, *names):
        jobs.queue.submit(job)
    rows = [jobs.ended(job) for job in names]
    assert [row.attempts for row in rows] == [1, 1, 1]
    assert sorted(rows, key=lambda row: row.finished_at) == rows
    eventually(lambda: len(jobs.made) >= 3)
    eventually(lambda: not jobs.queue._watched_jobs and not jobs.queue._settling and not jobs.queue._waiting)
    assert sorted(jobs.made) == [(f"number{number}", 1) for number in range(3)]

    monkeypatch.setattr(queue, "WATCH_S", 0.0)
    read = Mock()  # an idle queue does not read the database
    monkeypatch.setattr(jobs.queue.database, "session", read)
    for _ in range(5):
        jobs.queue._inbox.put(jobs.queue._check_jobs)
    eventually(jobs.queue._inbox.empty)
    assert not read.called


def test_closing_queue_returns_its_jobs_and_keeps_cancels(start_queue):
    jobs = start_queue(workers.ignore_cancel, JobLimits(cancel_s=60.0), training_workers=2)
    back, unwanted = jobs.submit("back"), jobs.submit("unwanted")
    pids = [jobs.running(job).progress["process"] for job in (back, unwanted)]
    jobs.change(unwanted, cancel_requested=True)
    jobs.queue.close()
    assert all(command(pid) == "" for pid in pids)
    seen = jobs.row(back)
    assert (seen.state, seen.attempts, seen.progress) == ("queued", 0, {"stage": "waiting"})
    assert messages_of(seen)[-1] == "the service was stopped while the job ran: queued again"
    assert jobs.row(unwanted).state == "cancelled"
