"""Recordings to upload, and common requests of tests."""

import io
import time
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import numpy as np

from lipcore.data.samples import Samples
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, simulate
from lipserve.states import ACTIVE
from service.learning.learners import Learners
from service.models.loaded import LoadedModels
from service.storage.storage import Storage
from service.telemetry.readiness import Readiness
from service.training.queue import JobQueue

QUICK = {"hyperparameter_samples": 20, "posterior_samples": 60, "max_iterations": 4}
"""Options of a fit that takes a fraction of a second."""
ENDLESS = {"hyperparameter_samples": 200, "posterior_samples": 60, "max_iterations": 10_000}
"""Options of a fit that takes about half a minute on 200 samples of `panda`, so that a test can end it."""

ADDRESS = "http://localhost"
"""Address of the service for an in-process client: without keys it accepts only names of this machine."""
DEADLINE = 300.0
"""Time limit for conditions that tests wait for, in seconds."""


@cache
def stream(robot: str = "double-pendulum", samples: int = 80, seed: int = 1, **kwargs: Any) -> Samples:
    """Return a simulated recording; equal arguments give the same object."""
    return simulate(load_robot(robot), Simulation(n_samples=samples, **{"speed": 5.0, **kwargs}), seed)


def arrays(samples: Samples, *names: str) -> dict[str, np.ndarray]:
    """Return arrays of a recording by name, by default all required ones."""
    return {name: getattr(samples, name) for name in names or ("t", "q", "dq", "ddq", "tau")}


def npz(**members: Any) -> bytes:
    """Return an NPZ archive."""
    file = io.BytesIO()
    np.savez(file, **members)
    return file.getvalue()


def columns(samples: Samples) -> dict[str, list[Any]]:
    """Return columns of a recording by canonical name, as lists of texts that a test may change."""
    table: dict[str, list[Any]] = {"t": [f"{value:.17g}" for value in samples.t]}
    for name in ("q", "dq", "ddq", "tau"):
        for joint, values in enumerate(getattr(samples, name).T, start=1):
            table[f"{name}{joint}"] = [f"{value:.17g}" for value in values]
    return table


def csv(table: Mapping[str, list[Any]], newline: str = "\n") -> bytes:
    """Return a CSV file of named columns."""
    rows = zip(*table.values(), strict=True)
    return (newline.join([",".join(table), *(",".join(map(str, row)) for row in rows)]) + newline).encode()


def post(api: Any, body: Any, media_type: str = "application/x-npz", **params: Any) -> Any:
    """Upload a body unchanged; return the answer."""
    return api.post("/v1/datasets", content=body, headers={"content-type": media_type}, params=params)


def upload(api: Any, samples: Samples, **params: Any) -> dict[str, Any]:
    """Upload a recording with its joint names; return the data set."""
    answer = post(api, npz(**arrays(samples), joint_names=np.array(samples.joint_names)), **params)
    assert answer.status_code == 201, answer.text
    return answer.json()


def queue(api: Any, model: str, *datasets: str, **request: Any) -> dict[str, Any]:
    """Queue a training job and return it: by default a quick `lip-chain`, nothing held out, promoted always."""
    body = {
        "model": model,
        "datasets": list(datasets),
        "estimator": "lip-chain",
        "options": QUICK,
        "holdout": None,
        "promotion": "always",
        **request,
    }
    answer = api.post("/v1/jobs", json=body)
    assert answer.status_code == 202, answer.text
    return answer.json()


def eventually(look: Callable[[], Any], seconds: float = DEADLINE) -> Any:
    """Wait until a condition is true and return its value; fail after the time limit."""
    end = time.monotonic() + seconds
    while not (seen := look()):
        assert time.monotonic() < end, f"waited {seconds:g} s in vain"
        time.sleep(0.02)
    return seen


def job(api: Any, name: str) -> dict[str, Any]:
    """Return a job in its present state."""
    answer = api.get(f"/v1/jobs/{name}")
    assert answer.status_code == 200, answer.text
    return answer.json()


def ended(api: Any, name: str) -> dict[str, Any]:
    """Wait until a job has ended in any state; return it."""
    return eventually(lambda: (seen := job(api, name))["state"] not in ACTIVE and seen)


def running(api: Any, name: str) -> dict[str, Any]:
    """Wait until a job has completed its first iteration; return it."""
    return eventually(lambda: (seen := job(api, name))["progress"]["iteration"] > 0 and seen)


def train(api: Any, model: str, *datasets: str, **request: Any) -> dict[str, Any]:
    """Train a model; return the succeeded job."""
    seen = ended(api, queue(api, model, *datasets, **request)["id"])
    assert seen["state"] == "succeeded", seen
    return seen


def error(answer: Any, status: int, code: str) -> dict[str, Any]:
    """Check that an answer is an error of the common shape; return its body."""
    assert answer.status_code == status, answer.text
    body = answer.json()
    assert set(body) == {"error"}
    assert set(body["error"]) == {"code", "message", "detail"}
    assert body["error"]["code"] == code
    assert body["error"]["message"]
    for item in body["error"]["detail"]:
        assert set(item) == {"field", "value", "expected"}
    return body["error"]


class ServiceParts:
    """The parts of a running service."""

    def __init__(self, state: Any) -> None:
        self.storage: Storage = state.storage
        self.settings, self.database = self.storage.settings, self.storage.database
        self.files, self.disk = self.storage.files, self.storage.disk
        self.loaded: LoadedModels = state.loaded
        self.jobs: JobQueue = state.jobs
        self.learners: Learners = state.learners
        self.readiness: Readiness = state.readiness
        self.stopping, self.meters = state.stopping, state.meters


def service_of(api: Any) -> ServiceParts:
    """Return the parts of the service behind a test client."""
    return ServiceParts(api.app.state)
