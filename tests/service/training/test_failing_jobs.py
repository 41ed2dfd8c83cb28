"""Jobs whose processes are superseded, killed or interrupted: each job is done once, and the service continues."""

import gc
import os
import signal

import pytest
from sqlalchemy import Dialect

from service.training import worker
from tests.service.data import ENDLESS, ended, error, queue, running, service_of, stream, upload


def test_superseded_attempt_publishes_nothing(api, pendulum, run_here, monkeypatch):
    """A service that is killed and restarted gives the job to a new process while the first may still run."""
    name = queue(api, "superseded", pendulum["id"])["id"]
    save = worker.lipcore.save

    def lose_and_save(*args):
        service_of(api).jobs.recover()
        return save(*args)

    monkeypatch.setattr(worker.lipcore, "save", lose_and_save)
    assert run_here(name)["state"] == "queued"
    error(api.get("/v1/models/superseded"), 404, "not_found")

    monkeypatch.setattr(worker.lipcore, "save", save)
    seen = run_here(name)
    assert (seen["state"], seen["version"], seen["attempts"]) == ("succeeded", 1, 2)


def test_job_that_is_submitted_twice_runs_once(api, pendulum, run_here):
    name = queue(api, "once", pendulum["id"])["id"]
    assert [run_here(name)["attempts"] for _ in range(2)] == [1, 1]
    assert api.get("/v1/models/once").json()["latest_version"] == 1


def test_process_keeps_nothing_of_earlier_jobs(api, pendulum, run_here):
    """SQLAlchemy caches compiled statements per dialect and table: the cache once grew with each job."""
    dialects = []
    for _ in range(3):
        assert run_here(queue(api, "one-of-many", pendulum["id"])["id"])["state"] == "succeeded"
        gc.collect()
        dialects.append(sum(isinstance(each, Dialect) for each in gc.get_objects()))
    assert dialects == dialects[:1] * 3


@pytest.mark.slow
@pytest.mark.parametrize(("number", "attempts"), [(signal.SIGKILL, 2), (signal.SIGINT, 1)])
def test_killed_process_costs_an_attempt_and_interrupt_none(api, number, attempts):
    """Ctrl-C reaches the whole process group; only the service decides when its processes end."""
    model, seconds_long = f"ended-by-{number}", {**ENDLESS, "hyperparameter_samples": 60, "max_iterations": 25}
    name = queue(api, model, upload(api, stream("panda", 100))["id"], options=seconds_long)["id"]
    running(api, name)
    workers = [pid for slot in service_of(api).jobs._slots for pid in slot._pool._processes or ()]
    assert workers
    for pid in workers:
        os.kill(pid, number)
    seen = ended(api, name)
    assert (seen["state"], seen["attempts"], seen["version"]) == ("succeeded", attempts, 1)
    assert api.get(f"/v1/models/{model}").json()["latest_version"] == 1
