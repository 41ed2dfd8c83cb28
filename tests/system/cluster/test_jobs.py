"""Jobs of several services, on a Dask cluster or with their own processes: each job ends once."""

import pytest

from service.storage.database import ReplicaRow
from service.storage.replicas import load_replica_id, read_live_ids
from service.training import worker
from service.training.cluster import ClusterQueue
from service.training.queue import JobQueue
from tests.service.data import eventually
from tests.service.server import command
from tests.service.training.conftest import messages_of
from tests.system.cluster import light
from tests.system.cluster.jobs import queues
from tests.system.cluster.workers import cluster

LOST_WORKER_MESSAGE = "the worker that ran the job is gone: queued again"


@pytest.fixture
def workers(shared, tmp_path):
    with cluster(shared, tmp_path / "cluster", "one", module="tests.system.cluster.light") as made:
        yield made


@pytest.fixture
def cluster_services(shared, workers):
    with queues(ClusterQueue, shared, cluster=workers.address) as new:
        yield new


def test_any_service_cancels_job_even_if_process_ignores_it(cluster_services):
    one, other = cluster_services("a"), cluster_services("b")
    deaf = one.add("deaf", "deaf")
    process = one.running(deaf).progress["process"]
    other.cancel(deaf)
    row = one.ended(deaf)
    assert (row.state, row.attempts) == ("cancelled", 1)
    assert "did not stop within 1 s and was killed" in messages_of(row)[-1]
    eventually(lambda: command(process) == "")
    waiting = one.add("obedient", "wait")
    one.running(waiting)
    other.cancel(waiting)
    assert messages_of(one.ended(waiting))[-1] == "obeyed"


def test_job_of_killed_worker_is_finished_by_another(cluster_services, workers):
    queue = cluster_services("a")
    job = queue.add("orphan", "wait")
    process = queue.running(job).progress["process"]
    workers.start("two")
    workers.wait_until_joined("two")
    workers.kill("one")
    assert queue.running(job, 2).progress["process"] != process
    queue.set_action(job, "finish")
    row = queue.ended(job)
    assert (row.state, row.attempts) == ("succeeded", 2)
    assert LOST_WORKER_MESSAGE in messages_of(row)
    eventually(lambda: command(process) == "")


def test_stopped_worker_returns_its_job(cluster_services, workers):
    queue = cluster_services("a")
    job = queue.add("handed", "wait")
    queue.running(job)
    assert workers.terminate("one") == 0
    assert "the worker was stopped while the job ran: queued again" in messages_of(queue.row(job))
    assert queue.row(job).attempts == 0
    workers.start("two")
    queue.running(job)
    queue.set_action(job, "finish")
    assert queue.ended(job).state == "succeeded"


def test_scheduler_outage_costs_no_attempt(cluster_services, workers):
    queue = cluster_services("a")
    runs, dies = queue.add("runs", "wait"), queue.add("later", "finish")
    queue.running(runs)
    workers.kill("scheduler")
    eventually(lambda: "cannot be reached" in (queue.cluster.problem or ""))
    queue.set_action(runs, "finish")
    assert queue.ended(runs).attempts == 1
    waits = queue.add("waits", "finish")
    workers.start_scheduler()
    workers.wait_until_joined("one", times=2)
    for job in (dies, waits):
        row = queue.ended(job)
        assert (row.state, row.attempts) == ("succeeded", 1)
    eventually(lambda: queue.cluster.problem is None)


def test_gpu_job_waits_for_worker_with_gpu(cluster_services, workers):
    queue = cluster_services("a")
    job, plain = queue.add("gpu", "wait", device="cuda"), queue.add("plain", "finish")
    assert queue.ended(plain).state == "succeeded"
    row = queue.row(job)
    assert (row.state, messages_of(row)) == ("queued", ["waiting for a worker of the cluster with a GPU"])
    assert queue.cluster.gpus == 0
    workers.start("two", "--gpus", "1")
    process = queue.running(job).progress["process"]
    assert workers.list_training_processes("two") == [process]
    queue.set_action(job, "finish")
    assert queue.ended(job).state == "succeeded"


def test_job_of_stopped_or_dead_service_is_adopted(cluster_services):
    one, other = cluster_services("a"), cluster_services("b")
    job = one.add("followed", "wait")
    process = one.running(job).progress["process"]
    assert one.row(job).owner == one.replicas.id
    one.replicas._beat = lambda: 1 / 0  # no more heartbeats, as after a kill
    eventually(lambda: other.row(job).owner == other.replicas.id)
    other.set_action(job, "finish")
    row = other.ended(job)
    assert (row.state, row.attempts, row.progress["process"]) == ("succeeded", 1, process)
    assert eventually(lambda: other.made) == [("followed", 1)]

    job = other.add("left", "wait")
    other.running(job)
    other.close()
    assert one.row(job).owner is None
    assert one.row(job).state == "running"
    third = cluster_services("c")
    eventually(lambda: third.row(job).owner == third.replicas.id)
    third.cancel(job)
    assert messages_of(third.ended(job))[-1] == "obeyed"


@pytest.fixture
def local_services(shared, monkeypatch):
    """Services with their own training processes."""
    monkeypatch.setattr(worker, "run", light.run)
    with queues(JobQueue, shared) as new:
        yield new


def test_any_service_may_start_a_queued_job(local_services):
    one, other = local_services("a"), local_services("b")
    first = one.add("first", "wait")
    assert one.running(first).owner == one.replicas.id
    second = one.add("second", "wait")  # the only process of the first service is busy
    assert one.running(second).owner == other.replicas.id
    other.cancel(first)  # any service may cancel
    one.cancel(second)
    assert [messages_of(one.ended(job))[-1] for job in (first, second)] == ["obeyed", "obeyed"]


def test_job_of_lost_service_is_restarted_by_one_other(local_services):
    one, other, third = (
        local_services("a"),
        local_services("b", training_workers=2),
        local_services("c", training_workers=2),
    )
    job = one.add("orphan", "wait")
    process = one.running(job).progress["process"]
    one.replicas._beat = lambda: 1 / 0  # no more heartbeats
    row = one.running(job, 2)
    assert row.owner in {other.replicas.id, third.replicas.id}
    assert "the service that ran the job is gone: queued again" in messages_of(row)
    eventually(lambda: command(process) == "" or not one._watched_jobs)  # it notices that it has lost the job
    one.set_action(job, "finish")
    row = one.ended(job)
    assert (row.state, row.attempts) == ("succeeded", 2)
    assert len(eventually(lambda: [*other.made, *third.made])) == 1


def test_stopping_service_returns_only_its_own_jobs(local_services):
    one, other = local_services("a"), local_services("b")
    first = one.add("first", "wait")
    one.running(first)
    second = one.add("second", "wait")
    process = one.running(second).progress["process"]
    one.close()
    waiting = other.row(first)
    assert (waiting.state, waiting.attempts, waiting.owner) == ("queued", 0, None)
    assert other.row(second).progress["process"] == process
    other.set_action(second, "finish")
    assert other.ended(second).attempts == 1
    other.running(first)
    other.set_action(first, "finish")
    assert other.ended(first).state == "succeeded"


def test_replica_id_is_stored_and_live_until_close(local_services, shared):
    one = local_services("a")
    assert load_replica_id(one.settings.home) == one.replicas.id
    with one.database.session() as session:
        assert read_live_ids(session, 5.0) == {one.replicas.id}
    one.replicas.close()
    with one.database.session() as session:
        assert session.get(ReplicaRow, one.replicas.id) is None


def test_service_without_heartbeat_claims_no_jobs(local_services):
    one, other = local_services("a"), local_services("b", replica_lost_s=30.0)
    job = one.add("kept", "wait")
    one.running(job)
    one.replicas._beat = lambda: 1 / 0
    eventually(lambda: one.replicas.id not in _read_live_ids(other, 1.0))
    with other.database.session() as session:
        # its own heartbeat is too old to judge others
        assert one.replicas.id not in other.replicas.list_claimable_owners(session)
    one.cancel(job)
    one.ended(job)


def _read_live_ids(queue, lost_s):
    with queue.database.session() as session:
        return read_live_ids(session, lost_s)
