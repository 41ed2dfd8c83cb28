"""Jobs that cannot be done say so and leave everything else as it was."""

from service.training import worker
from tests.service.data import error, job, queue, service_of


def test_an_attempt_that_was_superseded_publishes_nothing(api, pendulum, monkeypatch):
    """A service that was killed and started again hands the job to another process while the first may still run."""
    service = service_of(api)
    monkeypatch.setattr(service.jobs, "submit", lambda job: None)
    name = queue(api, "superseded", pendulum["id"])["id"]
    save = worker.lipcore.save

    def lose_and_save(*args):
        service.jobs.recover()
        return save(*args)

    monkeypatch.setattr(worker.lipcore, "save", lose_and_save)
    worker.run(service.settings, name)
    assert job(api, name)["state"] == "queued"
    error(api.get("/v1/models/superseded"), 404, "not_found")

    monkeypatch.setattr(worker.lipcore, "save", save)
    worker.run(service.settings, name)
    seen = job(api, name)
    assert (seen["state"], seen["version"], seen["attempts"]) == ("succeeded", 1, 2)


def test_a_job_is_run_once_even_if_it_is_handed_out_twice(api, pendulum, monkeypatch):
    service = service_of(api)
    monkeypatch.setattr(service.jobs, "submit", lambda job: None)
    name = queue(api, "once", pendulum["id"])["id"]
    for _ in range(2):
        worker.run(service.settings, name)
    assert job(api, name)["attempts"] == 1
    assert api.get("/v1/models/once").json()["latest_version"] == 1
