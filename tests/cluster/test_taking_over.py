"""Jobs of services that share a database, each with training processes of its own: one of them has each job."""

from __future__ import annotations

import pytest

from service.storage.database import ReplicaRow
from service.storage.replicas import alive, identity
from service.training import worker
from service.training.queue import JobQueue
from tests.cluster import light
from tests.cluster.jobs import LOST, Jobs, said
from tests.service.data import eventually
from tests.service.server import command


class Queue(Jobs, JobQueue):
    """The queue of one service, with a process of this host."""


@pytest.fixture
def services(shared, monkeypatch):
    monkeypatch.setattr(worker, "run", light.run)
    made = []

    def new(name, **settings):
        made.append(Queue(shared.settings(name, **{**LOST, **settings})))
        made[-1].recover()
        return made[-1]

    yield new
    for each in made:
        each.close()
        each.database.close()


def test_a_job_is_anybodys_until_one_hands_it_out(services):
    one, other = services("a"), services("b")
    first = one.add("first", "wait")
    assert one.running(first).owner == one.replicas.id
    second = one.add("second", "wait")  # the one process of the first service has something to do
    assert one.running(second).owner == other.replicas.id
    other.cancel(first)  # whom it is asked of does not matter
    one.cancel(second)
    assert [said(one.ended(job))[-1] for job in (first, second)] == ["obeyed", "obeyed"]


def test_a_job_of_a_service_that_is_gone_is_started_again_by_one_other(services):
    one, other, third = services("a"), services("b", training_workers=2), services("c", training_workers=2)
    job = one.add("orphan", "wait")
    process = one.running(job).progress["process"]
    one.replicas._beat = lambda: 1 / 0  # gives no more signs of life
    row = one.running(job, 2)
    assert row.owner in {other.replicas.id, third.replicas.id}
    assert "the service that had it run is gone: queued again" in said(row)
    eventually(lambda: command(process) == "" or not one._hands)  # which learns that it is not its own any more
    one.tell(job, "finish")
    row = one.ended(job)
    assert (row.state, row.attempts) == ("succeeded", 2)
    assert len(eventually(lambda: [*other.made, *third.made])) == 1


def test_a_service_that_stops_hands_back_its_own_jobs_alone(services):
    one, other = services("a"), services("b")
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


def test_a_service_knows_its_own_jobs_after_a_restart_and_others_know_that_it_lives(services, shared):
    one = services("a")
    assert identity(one.settings.home) == one.replicas.id
    with one.database.session() as session:
        assert alive(session, 5.0) == {one.replicas.id}
    one.replicas.close()
    with one.database.session() as session:
        assert session.get(ReplicaRow, one.replicas.id) is None


def test_who_could_give_no_sign_itself_takes_nobody_for_lost(services):
    one, other = services("a"), services("b", replica_lost_s=30.0)
    job = one.add("kept", "wait")
    one.running(job)
    one.replicas._beat = lambda: 1 / 0
    eventually(lambda: one.replicas.id not in _living(other, 1.0))
    with other.database.session() as session:
        assert one.replicas.id not in other.replicas.free(session)  # it lives too short a time to judge
    one.cancel(job)
    one.ended(job)


def _living(queue, lost_s):
    with queue.database.session() as session:
        return alive(session, lost_s)
