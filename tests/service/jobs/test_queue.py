"""The queue of jobs, with processes that hang, die and do not listen: every job ends or goes on."""

from service.storage import replicas
from service.training import metrics, queue
from service.training.lifecycle import JobLimits
from tests.service.data import eventually
from tests.service.jobs import workers
from tests.service.jobs.conftest import messages_of
from tests.service.server import command


def test_a_process_that_does_not_obey_a_cancel_is_ended_and_no_other_one(bench):
    jobs = bench(workers.deaf, JobLimits(cancel_s=0.1), training_workers=2)
    stubborn, other = jobs.submit("stubborn"), jobs.submit("other")
    first, beside = jobs.running(stubborn), jobs.running(other)
    jobs.cancel(stubborn)
    seen = jobs.ended(stubborn)
    assert (seen.state, seen.version, seen.attempts) == ("cancelled", None, 1)
    assert "did not stop within 0.1 s" in messages_of(seen)[-1]
    assert seen.finished_at
    eventually(lambda: command(first.progress["process"]) == "")

    still = jobs.row(other)
    assert (still.state, still.attempts, still.progress) == ("running", 1, beside.progress)
    assert command(still.progress["process"])


def test_a_cancel_ends_a_suspended_process_that_holds_the_lock_of_the_database(bench):
    jobs = bench(workers.frozen_with_the_lock, JobLimits(cancel_s=0.1))
    job = jobs.submit("locked")
    eventually((jobs.settings.home / "locked").exists)
    jobs.running(job)  # reading needs no lock
    eventually(lambda: jobs.queue._watched_jobs[0].ran)
    jobs.queue.stop(job)  # what the service does first: writing the wish would have to wait
    assert jobs.ended(job).state == "cancelled"


def test_a_process_without_a_sign_of_life_is_ended_and_its_job_started_again_but_not_for_ever(bench):
    jobs = bench(workers.frozen, JobLimits(heartbeat_s=0.3, attempts=2))
    seen = jobs.ended(jobs.submit("frozen"))
    assert (seen.state, seen.attempts, seen.error["code"]) == ("failed", 2, "interrupted")
    silent = "the training process gave no sign of life for 0.3 s and was ended"
    assert messages_of(seen)[:3] == ["started", f"{silent}: queued again", "started"]
    assert seen.error["message"].startswith(silent)
    assert "2 times" in seen.error["message"]


def test_the_service_knows_of_a_process_that_is_silent(bench, monkeypatch):
    jobs = bench(workers.frozen, JobLimits(heartbeat_s=1000.0))
    jobs.running(jobs.submit("frozen"))
    monkeypatch.setattr(metrics, "SILENT_S", 0.1)
    seen = eventually(lambda: (now := metrics.look(jobs.queue, lambda wrong: None))[0] == "warning" and now)
    assert seen[1].startswith("0 jobs waiting, 1 running; a training process has given no sign of life for ")


def test_a_job_whose_process_cannot_start_fails_in_the_end_and_the_service_knows(bench):
    jobs = bench(workers.stillborn, JobLimits(attempts=2, pause_s=0.05))
    seen = jobs.ended(jobs.submit("stillborn"))
    assert (seen.state, seen.attempts, seen.error["code"]) == ("failed", 0, "interrupted")
    assert "exit code 3" in seen.error["message"]
    assert "could be started for it, 2 times" in seen.error["message"]
    assert "exit code 3" in jobs.queue.problem


def test_where_the_system_starts_no_process_the_job_waits_for_one(bench, monkeypatch):
    jobs = bench(workers.well, JobLimits(pause_s=0.05))
    (slot,) = jobs.queue._slots
    start, refusals = slot.start, iter([OSError(11, "Resource temporarily unavailable")])

    def sometimes(*given):
        for refusal in refusals:
            raise refusal
        return start(*given)

    monkeypatch.setattr(slot, "start", sometimes)
    seen = jobs.ended(jobs.submit("patient"))
    assert (seen.state, seen.attempts) == ("succeeded", 1)
    assert "temporarily unavailable: it waits for another one" in messages_of(seen)[0]


def test_what_becomes_of_a_job_is_written_once_the_database_can_be(bench, monkeypatch):
    """Its process dies while another program has locked the database for longer than the service waits."""
    monkeypatch.setattr(queue, "RETRY_S", 0.05)
    jobs = bench(workers.frail)
    tried, settle = [], jobs.queue._settler.settle
    monkeypatch.setattr(jobs.queue._settler, "settle", lambda ended: (tried.append(ended), settle(ended))[1])
    job = jobs.submit("frail")
    jobs.running(job)
    eventually(lambda: any((jobs.settings.home / "versions").iterdir()))
    with jobs.database.transaction():
        (jobs.settings.home / "die").touch()
        eventually(lambda: len(tried) >= 2)
        assert jobs.row(job).state == "running"
    seen = jobs.ended(job)
    assert (seen.state, seen.attempts) == ("succeeded", 2)
    died = [message for message in messages_of(seen) if message.startswith("the training process ended with exit code")]
    assert [message.partition(": ")[2] for message in died] == ["queued again"]
    assert list((jobs.settings.home / "versions").iterdir()) == []  # what it had begun to write
    eventually(lambda: jobs.made == [("frail", 1)])


def test_jobs_that_nobody_has_are_found(bench, monkeypatch):
    monkeypatch.setattr(replicas, "RECONCILE_S", 0.05)
    jobs = bench(workers.well, JobLimits(heartbeat_s=30))
    forgotten = jobs.add("forgotten")
    orphan = jobs.add("orphan", state="running", attempts=1, heartbeat_at="2020-01-01T00:00:00.000+00:00")
    assert jobs.ended(forgotten).state == "succeeded"
    seen = jobs.ended(orphan)
    assert (seen.state, seen.attempts) == ("succeeded", 2)
    assert messages_of(seen)[0] == "no process runs it: queued again"


def test_jobs_are_handed_out_once_and_in_their_order(bench, monkeypatch):
    jobs = bench(workers.well)
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
    reads = []  # an idle queue does not look at the database
    monkeypatch.setattr(jobs.queue.database, "session", lambda: reads.append(1))
    for _ in range(5):
        jobs.queue._inbox.put(jobs.queue._look)
    eventually(jobs.queue._inbox.empty)
    assert reads == []


def test_a_queue_that_closes_hands_its_jobs_back_and_keeps_the_wish_to_cancel(bench):
    jobs = bench(workers.deaf, JobLimits(cancel_s=60.0), training_workers=2)
    back, unwanted = jobs.submit("back"), jobs.submit("unwanted")
    pids = [jobs.running(job).progress["process"] for job in (back, unwanted)]
    jobs.cancel(unwanted)
    jobs.queue.close()
    assert all(command(pid) == "" for pid in pids)
    seen = jobs.row(back)
    assert (seen.state, seen.attempts, seen.progress) == ("queued", 0, {"stage": "waiting"})
    assert messages_of(seen)[-1] == "the service was stopped while it ran: queued again"
    assert jobs.row(unwanted).state == "cancelled"
