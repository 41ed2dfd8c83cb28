"""Jobs of several services, on a Dask cluster or each with its own processes: all come and go, each job ends once."""

import pytest

from service.storage.database import ReplicaRow
from service.storage.replicas import load_replica_id, read_live_ids
from service.training import worker
from service.training.cluster import ClusterQueue
from service.training.queue import JobQueue
from tests.cluster import light
from tests.cluster.jobs import queues
from tests.cluster.workers import cluster
from tests.service.data import eventually
from tests.service.jobs.conftest import messages_of
from tests.service.server import command

WAITS = "waits for a worker of the cluster"
LOST_WORKER = "the worker that ran it is gone: queued again"


@pytest.fixture
def workers(shared, tmp_path):
    with cluster(shared, tmp_path / "cluster", "one", module="tests.cluster.light") as made:
        yield made


@pytest.fixture
def services(shared, workers):
    with queues(ClusterQueue, shared, cluster=workers.address) as new:
        yield new


def test_a_cancel_ends_a_process_that_does_not_obey_and_another_service_may_ask(services):
    one, other = services("a"), services("b")
    deaf = one.add("deaf", "deaf")
    process = one.running(deaf).progress["process"]
    other.cancel(deaf)
    row = one.ended(deaf)
    assert (row.state, row.attempts) == ("cancelled", 1)
    assert "did not stop within 1 s and was ended" in messages_of(row)[-1]
    eventually(lambda: command(process) == "")
    waiting = one.add("obedient", "wait")
    one.running(waiting)
    other.cancel(waiting)
    assert messages_of(one.ended(waiting))[-1] == "obeyed"


@pytest.mark.slow
def test_the_job_of_a_killed_worker_is_finished_by_another_one(services, workers):
    queue = services("a")
    job = queue.add("orphan", "wait")
    process = queue.running(job).progress["process"]
    workers.start("two")
    workers.joined("two")
    workers.kill("one")
    assert queue.running(job, 2).progress["process"] != process
    queue.tell(job, "finish")
    row = queue.ended(job)
    assert (row.state, row.attempts) == ("succeeded", 2)
    assert LOST_WORKER in messages_of(row)
    eventually(lambda: command(process) == "")


@pytest.mark.slow
def test_a_worker_that_is_told_to_stop_hands_its_job_back(services, workers):
    queue = services("a")
    job = queue.add("handed", "wait")
    queue.running(job)
    assert workers.terminate("one") == 0
    assert "its worker was stopped while it ran: queued again" in messages_of(queue.row(job))
    assert queue.row(job).attempts == 0
    workers.start("two")
    queue.running(job)
    queue.tell(job, "finish")
    assert queue.ended(job).state == "succeeded"


@pytest.mark.slow
def test_a_scheduler_that_is_gone_costs_no_attempt_and_what_waits_goes_on_after_it(services, workers):
    queue = services("a")
    runs, dies = queue.add("runs", "wait"), queue.add("later", "finish")
    queue.running(runs)
    workers.kill("scheduler")
    eventually(lambda: "cannot be reached" in (queue.cluster.problem or ""))
    queue.tell(runs, "finish")
    assert queue.ended(runs).attempts == 1
    waits = queue.add("waits", "finish")
    workers.start_scheduler()
    workers.joined("one", times=2)
    for job in (dies, waits):
        row = queue.ended(job)
        assert (row.state, row.attempts) == ("succeeded", 1)
    eventually(lambda: queue.cluster.problem is None)


@pytest.mark.slow
def test_a_job_that_needs_a_gpu_waits_for_a_worker_that_has_one(services, workers):
    queue = services("a")
    job, plain = queue.add("gpu", "wait", device="cuda"), queue.add("plain", "finish")
    assert queue.ended(plain).state == "succeeded"
    row = queue.row(job)
    assert (row.state, messages_of(row)) == ("queued", [f"{WAITS} with a GPU"])
    assert queue.cluster.gpus == 0
    workers.start("two", "--gpus", "1")
    process = queue.running(job).progress["process"]
    assert workers.training("two") == [process]
    queue.tell(job, "finish")
    assert queue.ended(job).state == "succeeded"


@pytest.mark.slow
def test_another_service_follows_the_job_of_one_that_stops_or_dies(services):
    one, other = services("a"), services("b")
    job = one.add("followed", "wait")
    process = one.running(job).progress["process"]
    assert one.row(job).owner == one.replicas.id
    one.replicas._beat = lambda: 1 / 0  # gives no more signs of life, as after a kill
    eventually(lambda: other.row(job).owner == other.replicas.id)
    other.tell(job, "finish")
    row = other.ended(job)
    assert (row.state, row.attempts, row.progress["process"]) == ("succeeded", 1, process)
    assert eventually(lambda: other.made) == [("followed", 1)]

    job = other.add("left", "wait")
    other.running(job)
    other.close()
    assert one.row(job).owner is None
    assert one.row(job).state == "running"
    third = services("c")
    eventually(lambda: third.row(job).owner == third.replicas.id)
    third.cancel(job)
    assert messages_of(third.ended(job))[-1] == "obeyed"


@pytest.fixture
def neighbours(shared, monkeypatch):
    """Services with training processes of their own."""
    monkeypatch.setattr(worker, "run", light.run)
    with queues(JobQueue, shared) as new:
        yield new


def test_a_job_is_anybodys_until_one_hands_it_out(neighbours):
    one, other = neighbours("a"), neighbours("b")
    first = one.add("first", "wait")
    assert one.running(first).owner == one.replicas.id
    second = one.add("second", "wait")  # the one process of the first service has something to do
    assert one.running(second).owner == other.replicas.id
    other.cancel(first)  # whom it is asked of does not matter
    one.cancel(second)
    assert [messages_of(one.ended(job))[-1] for job in (first, second)] == ["obeyed", "obeyed"]


@pytest.mark.slow
def test_a_job_of_a_service_that_is_gone_is_started_again_by_one_other(neighbours):
    one, other, third = neighbours("a"), neighbours("b", training_workers=2), neighbours("c", training_workers=2)
    job = one.add("orphan", "wait")
    process = one.running(job).progress["process"]
    one.replicas._beat = lambda: 1 / 0  # gives no more signs of life
    row = one.running(job, 2)
    assert row.owner in {other.replicas.id, third.replicas.id}
    assert "the service that had it run is gone: queued again" in messages_of(row)
    eventually(lambda: command(process) == "" or not one._watched_jobs)  # which learns that it is not its own any more
    one.tell(job, "finish")
    row = one.ended(job)
    assert (row.state, row.attempts) == ("succeeded", 2)
    assert len(eventually(lambda: [*other.made, *third.made])) == 1


def test_a_service_that_stops_hands_back_its_own_jobs_alone(neighbours):
    one, other = neighbours("a"), neighbours("b")
    first = one.add("first", "wait")
    one.running(first)
    second = one.add("second", "wait")
    process = one.running(second).progress["process"]
    one.close()
    waiting = other.row(first)
    assert (waiting.state, waiting.attempts, waiting.owner) == ("queued", 0, None)
    assert other.row(second).progress["process"] == process
    other.tell(second, "finish")
    assert other.ended(second).attempts == 1
    other.running(first)
    other.tell(first, "finish")
    assert other.ended(first).state == "succeeded"


def test_a_service_knows_its_own_jobs_after_a_restart_and_others_know_that_it_lives(neighbours, shared):
    one = neighbours("a")
    assert load_replica_id(one.settings.home) == one.replicas.id
    with one.database.session() as session:
        assert read_live_ids(session, 5.0) == {one.replicas.id}
    one.replicas.close()
    with one.database.session() as session:
        assert session.get(ReplicaRow, one.replicas.id) is None


def test_who_could_give_no_sign_itself_takes_nobody_for_lost(neighbours):
    one, other = neighbours("a"), neighbours("b", replica_lost_s=30.0)
    job = one.add("kept", "wait")
    one.running(job)
    one.replicas._beat = lambda: 1 / 0
    eventually(lambda: one.replicas.id not in _living(other, 1.0))
    with other.database.session() as session:
        # it lives too short a time to judge
        assert one.replicas.id not in other.replicas.list_claimable_owners(session)
    one.cancel(job)
    one.ended(job)


def _living(queue, lost_s):
    with queue.database.session() as session:
        return read_live_ids(session, lost_s)
