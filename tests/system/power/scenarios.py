"""A recorded service and scenarios for it. A mark is recorded when a request is sent, and when it is answered.

A mark maps names to states, as `read_facts` returns them: `{"alias/arm/production": 2}`. None: deleted; ANY: any state.
"""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import count
from typing import Any, Self

import httpx
import numpy as np
import pytest

from lipserve import StreamClient
from lipserve.states import ACTIVE
from service.models.archive import MEDIA_TYPE
from tests.service.data import QUICK, arrays, eventually, npz, stream
from tests.service.robots.test_robots import urdf
from tests.service.server import Server, command, descendants
from tests.system.faults.harness import SETTINGS
from tests.system.faults.injection import TIMEOUT_S
from tests.system.faults.ledger import ARM, STREAM_ID, batch, query_rows
from tests.system.power.recording import Recording

ANY = "*"
FRAMES_STREAM_ID = "frames"
"""Stream id of rows that are sent as frames."""
OPTIONS = {"contact_threshold": 100.0, "on_change": "learn", "auto_refresh": False}


class _PatientServer(Server):
    patience = TIMEOUT_S


def digest(*values: Any) -> str:
    """Return a digest of the exact values."""
    return hashlib.sha256(b"".join(np.asarray(each, "<f8").tobytes() for each in values)).hexdigest()[:16]


def batch_digest(body: dict[str, Any]) -> str:
    """Return the digest of an observation batch."""
    return digest(*(body[name] for name in ("q", "dq", "ddq", "tau")))


class RecordedService:
    """A recorded service and its client; a context manager. Threads may share it if their requests are about different
    things.

    initial_facts: content of its home before the recording; shipped: whether the first start installs the shipped
    model.
    """

    def __init__(
        self, recording: Recording, initial_facts: dict[str, Any] | None = None, shipped: bool = True, **settings: str
    ) -> None:
        self.recording, self.home = recording, recording.home
        chosen = {f"LIPSERVE_{name}": value for name, value in (SETTINGS | settings).items()}
        self.environment = {**recording.environment, **chosen}
        self._count, self._sequence, self._first = count(), count(), shipped
        recording.record_initial_state()
        if initial_facts is not None:
            recording.mark(number=-1, acknowledged=initial_facts)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if hasattr(self, "server"):
            self.server.__exit__(None, None, None)

    @property
    def client(self) -> httpx.Client:
        """The client of the current server process."""
        return self.server.client

    @contextmanager
    def recorded_request(self, kind: str, **wanted: Any) -> Iterator[dict[str, Any]]:
        """Mark the start of a request, and after the block its response. The block may change the acknowledged
        facts. If it fails, the request stays unanswered."""
        number = next(self._count)
        self.recording.mark(number=number, kind=kind, wanted=wanted)
        acknowledged = dict(wanted)
        yield acknowledged
        self.recording.mark(number=number, kind=kind, acknowledged=acknowledged)

    def start(self, kind: str = "start") -> None:
        """Start the service and wait until it is ready; the first start installs the shipped model."""
        shipped = {"version/panda-sim/1": ANY, "alias/panda-sim/serving": 1} if self._first else {}
        with self.recorded_request(kind, **shipped) as acknowledged:
            self.server = _PatientServer(self.home, log=self.recording.folder / "log", **self.environment)
            if self._first:
                acknowledged["version/panda-sim/1"] = self._created_at("panda-sim", 1)
        self._first = False

    def stop(self) -> None:
        """Stop the service by a signal."""
        self.server.client.close()
        assert self.server.terminate() in (0, -signal.SIGTERM), self.server.log.read_text()

    def kill(self) -> None:
        """Kill the service and its children."""
        orphans = descendants(self.server.process.pid)
        self.server.client.close()
        self.server.kill()
        eventually(lambda: all(command(pid) == "" for pid in orphans), TIMEOUT_S)

    def expect_rejection(self, pattern: str, request: Callable[[], object], skip: int = 0) -> None:
        """Make a sync fail during a request, and check that the request is rejected."""
        self.recording.fail_syncs(pattern, skip)
        with pytest.raises(AssertionError, match="storage_unavailable"):
            request()
        assert self.recording.count_failed_syncs() == 1

    def command(self, *arguments: str) -> str:
        """Run `lipserve` on the home; return what it prints."""
        environment = {**os.environ, **self.environment, "LIPSERVE_HOME": str(self.home)}
        line = [sys.executable, "-m", "service", *arguments]
        return subprocess.run(line, env=environment, check=True, capture_output=True, text=True).stdout

    def upload(self, seed: int) -> str:
        """Upload a recording; return its id."""
        samples, name = stream(samples=60, seed=seed), f"recording-{seed}"
        body = npz(**arrays(samples), joint_names=np.array(samples.joint_names))
        with self.recorded_request("upload", **{f"dataset/{name}": ANY}) as acknowledged:
            answer = self._post("/v1/datasets", "application/x-npz", body, name=name)
            acknowledged[f"dataset/{name}"] = answer["sha256"]
        return answer["id"]

    def upload_robot(self, name: str) -> None:
        """Upload a URDF."""
        body = urdf(name)
        with self.recorded_request("upload", **{f"robot/{name}": hashlib.sha256(body).hexdigest()}):
            self._post("/v1/robots", "application/xml", body, name=name)

    def delete_dataset(self, name: str, dataset: str) -> None:
        """Delete a recording."""
        with self.recorded_request("upload", **{f"dataset/{name}": None}):
            self._check_success(self.client.delete(f"/v1/datasets/{dataset}"))

    def train(self, model: str, dataset: str, version: int) -> None:
        """Train the next version of a model, and wait until it serves."""
        body = {"model": model, "datasets": [dataset], "options": QUICK, "estimator": "lip-chain", "holdout": None}
        made = {f"trained/{model}": version, f"version/{model}/{version}": ANY, f"alias/{model}/serving": version}
        with self.recorded_request("publication", **made) as acknowledged:
            with self.recorded_request("publication", **{f"jobs/{model}": version}):
                job = self._check_success(self.client.post("/v1/jobs", json=body | {"promotion": "always"}))["id"]
            seen = eventually(lambda: (at := self._job(job))["state"] not in ACTIVE and at, TIMEOUT_S)
            assert seen["state"] == "succeeded", seen
            acknowledged[f"version/{model}/{version}"] = self._created_at(model, version)

    def change_learning(self, threshold: float = 100.0) -> None:
        """Change the learning options of the model."""
        with self.recorded_request("promotion", **{f"learning/{ARM}": threshold}):
            self._check_success(
                self.client.put(f"/v1/models/{ARM}/learning", json=OPTIONS | {"contact_threshold": threshold})
            )

    def observe(self, sequence: int | None = None) -> tuple[int, int]:
        """Send a batch, the next one by default; return its sequence and revision."""
        sequence = next(self._sequence) if sequence is None else sequence
        body = batch(sequence)
        with self.recorded_request(
            "observation", **{f"batch/{ARM}/{STREAM_ID}/{sequence}": f"learnt {batch_digest(body)}"}
        ):
            answer = self._check_success(self.client.post(f"/v1/models/{ARM}/observations", json=body))
            assert (answer["duplicate"], answer["state"]) == (False, "learnt"), answer
        return sequence, answer["revision"]

    def unlearn(self, sequence: int) -> None:
        """Unlearn a batch."""
        name = f"batch/{ARM}/{STREAM_ID}/{sequence}"
        with self.recorded_request("observation", **{name: f"void {batch_digest(batch(sequence))}"}):
            self._check_success(self.client.delete(f"/v1/models/{ARM}/observations/{STREAM_ID}/{sequence}"))

    def stream_frames(self, size: int) -> None:
        """Send rows as frames of a stream."""
        batches = stream(seed=31, samples=200, viscous=2.0)
        sent = [{name: getattr(batches, name)[i] for name in ("q", "dq", "ddq", "tau")} for i in range(size)]
        names = [f"frame/{ARM}/{FRAMES_STREAM_ID}/{i}" for i in range(1, size + 1)]
        wanted = {name: f"learnt {digest(*row.values())}" for name, row in zip(names, sent, strict=True)}
        with (
            self.recorded_request("observation", **wanted),
            StreamClient(ARM, self.server.url, stream_id=FRAMES_STREAM_ID) as client,
        ):
            for row in sent:
                client.predict(**row)
            eventually(lambda: client.predict(**sent[0] | {"tau": None}) and client.learnt.through >= size, TIMEOUT_S)

    def rollback(self, revision: int, undone: Iterable[int]) -> None:
        """Roll back to a revision, which undoes these batches."""
        void = {f"batch/{ARM}/{STREAM_ID}/{each}": f"void {batch_digest(batch(each))}" for each in undone}
        with self.recorded_request("observation", **void):
            self._check_success(self.client.post(f"/v1/models/{ARM}/rollback", json={"revision": revision}))

    def move_alias(self, alias: str, version: int) -> None:
        """Move an alias to a version."""
        with self.recorded_request("promotion", **{f"alias/{ARM}/{alias}": version}):
            self._check_success(self.client.put(f"/v1/models/{ARM}/aliases/{alias}", json={"version": version}))

    def remove_alias(self, alias: str) -> None:
        """Remove an alias."""
        with self.recorded_request("promotion", **{f"alias/{ARM}/{alias}": None}):
            self._check_success(self.client.delete(f"/v1/models/{ARM}/aliases/{alias}"))

    def serve(self, version: int) -> None:
        """Change the serving version."""
        with self.recorded_request("promotion", **{f"alias/{ARM}/serving": version}):
            self._check_success(self.client.post(f"/v1/models/{ARM}/rollback", json={"version": version}))

    def read_serving_version(self) -> int:
        """Return the serving version; a state that was read counts as acknowledged."""
        with self.recorded_request("promotion") as acknowledged:
            version = self._check_success(self.client.get(f"/v1/models/{ARM}"))["serving_version"]
            acknowledged[f"alias/{ARM}/serving"] = version
        return version

    def import_version(self, model: str, version: int) -> int:
        """Import a version as the next one of a model; return the serving version."""
        with self.client.stream("GET", f"/v1/models/{ARM}/export", params={"version": 1, "learnt": False}) as answer:
            archive = answer.read()
            assert answer.is_success, archive
        made, serving = f"version/{model}/{version}", f"alias/{model}/serving"
        with self.recorded_request("publication", **{made: ANY, serving: ANY}) as acknowledged:
            answer = self._post("/v1/models/import", MEDIA_TYPE, archive, name=model)
            assert answer["version"] == version
            acknowledged[made] = answer["created_at"]
            answers: int = self._check_success(self.client.get(f"/v1/models/{model}"))["serving_version"]
            acknowledged[serving] = answers
            assert version > 1 or answers == 1
        return answers

    def delete_version(self, model: str, version: int) -> None:
        """Delete a version."""
        with self.recorded_request("publication", **{f"version/{model}/{version}": None}):
            self._check_success(self.client.delete(f"/v1/models/{model}/versions/{version}"))

    def delete_model(self, model: str, version: int) -> None:
        """Delete a model that has one version."""
        gone = {f"version/{model}/{version}": None, f"alias/{model}/serving": None}
        with self.recorded_request("publication", **gone):
            self._check_success(self.client.delete(f"/v1/models/{model}"))

    def make_key(self, name: str) -> None:
        """Make an API key."""
        with self.recorded_request("promotion", **{f"key/{name}": "valid"}):
            self.command("keys", "create", "--name", name, "--scope", "read")

    def wait_until_stored(self) -> None:
        """Wait until a snapshot contains everything learnt; this is not acknowledged to clients."""
        newest = "SELECT max(number) FROM {} WHERE model = ?"
        with self.recorded_request("publication"):
            eventually(
                lambda: (
                    query_rows(self.home, newest.format("snapshots"), ARM)
                    == query_rows(self.home, newest.format("events"), ARM)
                ),
                TIMEOUT_S,
            )

    def run_concurrently(self, *parts: Any) -> None:
        """Run several functions at the same time."""
        with ThreadPoolExecutor(len(parts)) as pool:
            for each in [pool.submit(part) for part in parts]:
                each.result()

    def _created_at(self, model: str, version: int) -> Any:
        return self._check_success(self.client.get(f"/v1/models/{model}/versions/{version}"))["created_at"]

    def _job(self, job: str) -> Any:
        return self._check_success(self.client.get(f"/v1/jobs/{job}"))

    def _post(self, path: str, kind: str, body: bytes, **params: str) -> Any:
        return self._check_success(self.client.post(path, content=body, headers={"content-type": kind}, params=params))

    def _check_success(self, answer: httpx.Response) -> Any:
        assert answer.is_success, answer.text
        return answer.json() if answer.content else None


def run_lifetime(service: RecordedService, rounds: int) -> None:
    """Store everything that a home can hold, mostly several times and concurrently, from the first start on."""
    service.start()
    trained = service.upload(1)
    for version in (1, 2):
        service.train(ARM, trained, version)
    service.change_learning()
    for each in range(rounds):
        service.run_concurrently(
            lambda at=each: _run_uploads(service, at),
            lambda: _run_observations(service),
            lambda at=each: _run_versions(service, at),
        )
        service.wait_until_stored()
    service.stream_frames(60)
    service.make_key("guest")
    service.stop()
    service.start()
    run_each_kind(service, rounds, serving=2)
    service.wait_until_stored()
    service.stop()


def _run_uploads(service: RecordedService, number: int) -> None:
    dataset = service.upload(100 + 2 * number)
    service.upload_robot(f"robot-{number}")
    service.upload(101 + 2 * number)
    service.delete_dataset(f"recording-{100 + 2 * number}", dataset)


def _run_observations(service: RecordedService) -> None:
    batches = [service.observe() for _ in range(8)]
    service.unlearn(batches[3][0])
    service.rollback(batches[5][1], [each for each, _ in batches[6:]])
    service.observe()


def _run_versions(service: RecordedService, number: int) -> None:
    for version in (1, 2):
        service.move_alias("production", version)
    service.import_version(f"imported-{number}", 1)
    service.serve(1)
    serving = service.import_version(f"imported-{number}", 2)
    service.delete_version(f"imported-{number}", 3 - serving)
    service.serve(2)
    service.remove_alias("production")
    service.delete_model(f"imported-{number}", serving)


def run_each_kind(service: RecordedService, number: int, serving: int = 1) -> None:
    """Send one or more requests of each kind, in sequence; `serving` is the serving version at start and end."""
    dataset = service.upload(100 + 2 * number)
    service.upload_robot(f"robot-{number}")
    batches = [service.observe() for _ in range(4)]
    service.move_alias("production", 2)
    service.import_version(f"imported-{number}", 1)
    service.serve(3 - serving)
    service.unlearn(batches[1][0])
    service.delete_dataset(f"recording-{100 + 2 * number}", dataset)
    service.serve(serving)
    service.delete_model(f"imported-{number}", 1)


def run_upgrade(service: RecordedService) -> None:
    """Migrate a home of an earlier release, and use it."""
    service.start("migration")
    dataset = service.upload(1)
    service.upload_robot("robot")
    service.make_key("guest")
    service.delete_dataset("recording-1", dataset)
    service.kill()
    service.start("migration")
    service.upload(2)
    service.stop()


FILE = "*/lipserve.sqlite3"


def run_failing_syncs(service: RecordedService, dataset: str) -> None:
    """Make a sync fail during each kind of request, retry the request, then kill and restart the service."""
    expect_rejection = service.expect_rejection
    for number, pattern in enumerate(["*.draft", "*/datasets", f"{FILE}-wal"]):
        expect_rejection(pattern, lambda at=number: service.upload(300 + at))
        service.upload(300 + number)
    expect_rejection(f"{FILE}-wal", lambda: service.upload_robot("late"))
    expect_rejection(f"{FILE}-wal", lambda: service.delete_dataset("recording-299", dataset))
    for number, pattern in enumerate(["*/model.safetensors", "*/.draft-mv_*", "*/versions", f"{FILE}-wal"]):
        expect_rejection(pattern, lambda at=number: service.import_version(f"late-{at}", 1))
        service.import_version(f"late-{number}", 1)
    batches, _ = service.observe()
    # its learnt friction is negative: the alarm is written at any time after the answer
    eventually(lambda: "friction" in service.client.get(f"/v1/models/{ARM}/alarms").text, TIMEOUT_S)
    for number in range(batches + 1, batches + 5):
        expect_rejection(f"{FILE}-wal", lambda at=number: service.observe(at))
        expect_rejection(f"{FILE}-wal", lambda: service.unlearn(batches))
        assert service.observe()[0] == number
    for request in (lambda: service.move_alias("production", 2), lambda: service.serve(2), lambda: service.serve(2)):
        expect_rejection(f"{FILE}-wal", request)
    service.kill()
    service.start()
    run_each_kind(service, 900, service.read_serving_version())
    service.kill()
    service.start()
    service.observe()
    service.kill()
