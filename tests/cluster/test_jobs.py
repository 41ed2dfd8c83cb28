"""Jobs on a Dask cluster of real processes: workers, schedulers and services come and go; every job ends once.

The queues are those of services, the training processes do light work instead of a fit.
"""

from __future__ import annotations

import pytest

from service.training.cluster import ClusterQueue
from tests.cluster.jobs import LOST, Jobs, said
from tests.cluster.workers import cluster
from tests.service.data import eventually
from tests.service.server import command

WAITS = "waits for a worker of the cluster"
LOST_WORKER = "the worker that ran it is gone: queued again"


class Queue(Jobs, ClusterQueue):
    """The queue of one service, on a cluster."""


@pytest.fixture
def workers(shared, tmp_path):
    with cluster(shared, tmp_path / "cluster", "one", module="tests.cluster.light") as made:
        yield made


@pytest.fixture
def services(shared, workers):
    """Makes the queue of a service with a home of that name."""
    made = []

    def new(name, **settings):
        made.append(Queue(shared.settings(name, cluster=workers.address, **LOST, **settings)))
        made[-1].recover()
        return made[-1]

    yield new
    for each in made:
        each.close()
        each.database.close()


@pytest.mark.slow
def test_jobs_run_one_after_the_other_and_the_one_that_ends_is_told(services):
    first = services("a")
    names = [first.add(f"n{number}", "finish") for number in range(3)]
    rows = [first.ended(job) for job in names]
    assert [(row.state, row.attempts, row.owner) for row in rows] == [("succeeded", 1, first.replicas.id)] * 3
    assert said(rows[0]) == [WAITS, "started", "done"]
    assert sorted(eventually(lambda: len(first.made) == 3 and first.made)) == [("n0", 1), ("n1", 1), ("n2", 1)]


@pytest.mark.slow
def test_a_cancel_ends_a_process_that_does_not_obey_and_another_service_may_ask(services):
    one, other = services("a"), services("b")
    deaf = one.add("deaf", "deaf")
    process = one.running(deaf).progress["process"]
    other.cancel(deaf)
    row = one.ended(deaf)
    assert (row.state, row.attempts) == ("cancelled", 1)
    assert "did not stop within 1 s and was ended" in said(row)[-1]
    eventually(lambda: command(process) == "")
    waiting = one.add("obedient", "wait")
    one.running(waiting)
    other.cancel(waiting)
    assert said(one.ended(waiting))[-1] == "obeyed"


@pytest.mark.slow
def test_a_process_that_dies_or_hangs_is_an_attempt(services):
    queue = services("a")
    row = queue.ended(queue.add("dies", "die"))
    assert (row.state, row.attempts, row.error["code"]) == ("failed", 3, "interrupted")
    assert "exit code 3" in row.error["message"]


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
    assert LOST_WORKER in said(row)
    eventually(lambda: command(process) == "")


@pytest.mark.slow
def test_a_worker_that_is_told_to_stop_hands_its_job_back(services, workers):
    queue = services("a")
    job = queue.add("handed", "wait")
    queue.running(job)
    assert workers.terminate("one") == 0
    assert "its worker was stopped while it ran: queued again" in said(queue.row(job))
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
    assert (row.state, said(row)) == ("queued", [f"{WAITS} with a GPU"])
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
    assert said(third.ended(job))[-1] == "obeyed"
