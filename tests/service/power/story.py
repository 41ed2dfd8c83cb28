"""What a service lives through while it is recorded: each request is marked when it is sent, and when it is answered.

A mark names things and what becomes of them, as `facts.py` finds them in a home: `{"alias/arm/production": 2}`. None:
it is gone; ANY: whatever the service makes of it.
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
from tests.service.faults.house import SETTINGS
from tests.service.faults.injection import PATIENCE
from tests.service.faults.ledger import ARM, SOURCE, batch, rows
from tests.service.power.recording import Recording
from tests.service.server import Server, children, command
from tests.service.test_robots import urdf

ANY = "*"
FRAMES = "frames"
"""Stream id of frames."""
OPTIONS = {"contact_threshold": 100.0, "on_change": "learn", "auto_refresh": False}


class _Patient(Server):
    patience = PATIENCE


def digest(*values: Any) -> str:
    """Of what rows hold, to the bit."""
    return hashlib.sha256(b"".join(np.asarray(each, "<f8").tobytes() for each in values)).hexdigest()[:16]


def digest_of(body: dict[str, Any]) -> str:
    """Of what an observation batch holds."""
    return digest(*(body[name] for name in ("q", "dq", "ddq", "tau")))


class Story:
    """A service that is recorded; its client. Use it as a context manager. From several threads, each of which asks for
    things of its own.

    known: what is in its home before the recording begins, as `facts` names it; shipped: whether the first start adds
    the model that comes with the service.
    """

    def __init__(
        self, recording: Recording, known: dict[str, Any] | None = None, shipped: bool = True, **settings: str
    ) -> None:
        self.recording, self.home = recording, recording.home
        chosen = {f"LIPSERVE_{name}": value for name, value in (SETTINGS | settings).items()}
        self.environment = {**recording.environment, **chosen}
        self._count, self._sequence, self._first = count(), count(), shipped
        recording.begin()
        if known is not None:
            recording.mark(number=-1, told=known)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if hasattr(self, "server"):
            self.server.__exit__(None, None, None)

    @property
    def client(self) -> httpx.Client:
        """Of the service as it runs now."""
        return self.server.client

    @contextmanager
    def asking(self, kind: str, **wanted: Any) -> Iterator[dict[str, Any]]:
        """Mark that something is asked for, and at the end of the block that it was answered; what then holds is what
        was wanted, or what the block puts there. Where the block fails, it was never answered."""
        number = next(self._count)
        self.recording.mark(number=number, kind=kind, wanted=wanted)
        told = dict(wanted)
        yield told
        self.recording.mark(number=number, kind=kind, told=told)

    def start(self, kind: str = "start") -> None:
        """Start the service and wait until it is ready; a new home has the shipped model then."""
        shipped = {"version/panda-sim/1": ANY, "alias/panda-sim/serving": 1} if self._first else {}
        with self.asking(kind, **shipped) as told:
            self.server = _Patient(self.home, log=self.recording.folder / "log", **self.environment)
            if self._first:
                told["version/panda-sim/1"] = self._made_at("panda-sim", 1)
        self._first = False

    def stop(self) -> None:
        """End it in good order."""
        self.server.client.close()
        assert self.server.terminate() in (0, -signal.SIGTERM), self.server.log.read_text()

    def kill(self) -> None:
        """End it at once, with its children."""
        orphans = children(self.server.process.pid)
        self.server.client.close()
        self.server.kill()
        eventually(lambda: all(command(pid) == "" for pid in orphans), PATIENCE)

    def refuse(self, pattern: str, ask: Callable[[], object], skip: int = 0) -> None:
        """Ask for something while a sync fails, and see that it is refused."""
        self.recording.fail(pattern, skip)
        with pytest.raises(AssertionError, match="storage_unavailable"):
            ask()
        assert self.recording.failed() == 1

    def command(self, *arguments: str) -> str:
        """Run `lipserve` on the home; return what it prints."""
        environment = {**os.environ, **self.environment, "LIPSERVE_HOME": str(self.home)}
        line = [sys.executable, "-m", "service", *arguments]
        return subprocess.run(line, env=environment, check=True, capture_output=True, text=True).stdout

    def upload(self, seed: int) -> str:
        """Upload a recording; return its id."""
        samples, name = stream(samples=60, seed=seed), f"recording-{seed}"
        body = npz(**arrays(samples), joint_names=np.array(samples.joint_names))
        with self.asking("upload", **{f"dataset/{name}": ANY}) as told:
            answer = self._post("/v1/datasets", "application/x-npz", body, name=name)
            told[f"dataset/{name}"] = answer["sha256"]
        return answer["id"]

    def upload_robot(self, name: str) -> None:
        """Upload a URDF."""
        body = urdf(name)
        with self.asking("upload", **{f"robot/{name}": hashlib.sha256(body).hexdigest()}):
            self._post("/v1/robots", "application/xml", body, name=name)

    def delete_dataset(self, name: str, dataset: str) -> None:
        """Delete a recording."""
        with self.asking("upload", **{f"dataset/{name}": None}):
            self._done(self.client.delete(f"/v1/datasets/{dataset}"))

    def train(self, model: str, dataset: str, version: int) -> None:
        """Train the next version of a model, which answers from then on, and wait for it."""
        body = {"model": model, "datasets": [dataset], "options": QUICK, "estimator": "lip-chain", "holdout": None}
        made = {f"trained/{model}": version, f"version/{model}/{version}": ANY, f"alias/{model}/serving": version}
        with self.asking("publication", **made) as told:
            with self.asking("publication", **{f"jobs/{model}": version}):
                job = self._done(self.client.post("/v1/jobs", json=body | {"promotion": "always"}))["id"]
            seen = eventually(lambda: (at := self._job(job))["state"] not in ACTIVE and at, PATIENCE)
            assert seen["state"] == "succeeded", seen
            told[f"version/{model}/{version}"] = self._made_at(model, version)

    def settings(self, threshold: float = 100.0) -> None:
        """Change how the model learns."""
        with self.asking("promotion", **{f"learning/{ARM}": threshold}):
            self._done(self.client.put(f"/v1/models/{ARM}/learning", json=OPTIONS | {"contact_threshold": threshold}))

    def observe(self, sequence: int | None = None) -> tuple[int, int]:
        """Teach a batch, the next one by default; return its sequence and the revision that contains it."""
        sequence = next(self._sequence) if sequence is None else sequence
        body = batch(sequence)
        with self.asking("observation", **{f"batch/{ARM}/{SOURCE}/{sequence}": f"learnt {digest_of(body)}"}):
            answer = self._done(self.client.post(f"/v1/models/{ARM}/observations", json=body))
            assert (answer["duplicate"], answer["state"]) == (False, "learnt"), answer
        return sequence, answer["revision"]

    def unlearn(self, sequence: int) -> None:
        """Take a batch back."""
        name = f"batch/{ARM}/{SOURCE}/{sequence}"
        with self.asking("observation", **{name: f"void {digest_of(batch(sequence))}"}):
            self._done(self.client.delete(f"/v1/models/{ARM}/observations/{SOURCE}/{sequence}"))

    def frames(self, size: int) -> None:
        """Teach over a stream."""
        taught = stream(seed=31, samples=200, viscous=2.0)
        sent = [{name: getattr(taught, name)[i] for name in ("q", "dq", "ddq", "tau")} for i in range(size)]
        names = [f"frame/{ARM}/{FRAMES}/{i}" for i in range(1, size + 1)]
        wanted = {name: f"learnt {digest(*row.values())}" for name, row in zip(names, sent, strict=True)}
        with self.asking("observation", **wanted), StreamClient(ARM, self.server.url, stream_id=FRAMES) as client:
            for row in sent:
                client.predict(**row)
            eventually(lambda: client.predict(**sent[0] | {"tau": None}) and client.learnt.through >= size, PATIENCE)

    def rollback(self, revision: int, undone: Iterable[int]) -> None:
        """Take back what was learnt after a revision: batches of these sequences."""
        void = {f"batch/{ARM}/{SOURCE}/{each}": f"void {digest_of(batch(each))}" for each in undone}
        with self.asking("observation", **void):
            self._done(self.client.post(f"/v1/models/{ARM}/rollback", json={"revision": revision}))

    def point(self, alias: str, version: int) -> None:
        """Let an alias point to a version."""
        with self.asking("promotion", **{f"alias/{ARM}/{alias}": version}):
            self._done(self.client.put(f"/v1/models/{ARM}/aliases/{alias}", json={"version": version}))

    def remove_alias(self, alias: str) -> None:
        """Remove an alias."""
        with self.asking("promotion", **{f"alias/{ARM}/{alias}": None}):
            self._done(self.client.delete(f"/v1/models/{ARM}/aliases/{alias}"))

    def serve(self, version: int) -> None:
        """Let a version answer."""
        with self.asking("promotion", **{f"alias/{ARM}/serving": version}):
            self._done(self.client.post(f"/v1/models/{ARM}/rollback", json={"version": version}))

    def look(self) -> int:
        """The version that answers: what a client sees is a promise, too."""
        with self.asking("promotion") as told:
            version = self._done(self.client.get(f"/v1/models/{ARM}"))["serving_version"]
            told[f"alias/{ARM}/serving"] = version
        return version

    def publish(self, model: str, version: int) -> None:
        """Import a version as the next one of a model: it waits, as nothing was held out of its training."""
        with self.client.stream("GET", f"/v1/models/{ARM}/export", params={"version": 1, "learnt": False}) as answer:
            archive = answer.read()
        with self.asking("publication", **{f"version/{model}/{version}": ANY}) as told:
            answer = self._post("/v1/models/import", MEDIA_TYPE, archive, name=model)
            assert answer["version"] == version
            told[f"version/{model}/{version}"] = answer["created_at"]

    def delete_version(self, model: str, version: int) -> None:
        """Delete a version."""
        with self.asking("publication", **{f"version/{model}/{version}": None}):
            self._done(self.client.delete(f"/v1/models/{model}/versions/{version}"))

    def delete_model(self, model: str, version: int) -> None:
        """Delete a model, of one version."""
        with self.asking("publication", **{f"version/{model}/{version}": None}):
            self._done(self.client.delete(f"/v1/models/{model}"))

    def make_key(self, name: str) -> None:
        """Make an API key."""
        with self.asking("promotion", **{f"key/{name}": "valid"}):
            self.command("keys", "create", "--name", name, "--scope", "read")

    def store(self) -> None:
        """Wait until all that was learnt is stored, of which nobody is told."""
        newest = "SELECT max(number) FROM {} WHERE model = ?"
        with self.asking("publication"):
            eventually(
                lambda: (
                    rows(self.home, newest.format("snapshots"), ARM) == rows(self.home, newest.format("events"), ARM)
                ),
                PATIENCE,
            )

    def together(self, *parts: Any) -> None:
        """Do several things at once."""
        with ThreadPoolExecutor(len(parts)) as pool:
            for each in [pool.submit(part) for part in parts]:
                each.result()

    def _made_at(self, model: str, version: int) -> Any:
        return self._done(self.client.get(f"/v1/models/{model}/versions/{version}"))["created_at"]

    def _job(self, job: str) -> Any:
        return self._done(self.client.get(f"/v1/jobs/{job}"))

    def _post(self, path: str, kind: str, body: bytes, **params: str) -> Any:
        return self._done(self.client.post(path, content=body, headers={"content-type": kind}, params=params))

    def _done(self, answer: httpx.Response) -> Any:
        assert answer.is_success, answer.text
        return answer.json() if answer.content else None


def life(story: Story, rounds: int) -> None:
    """A home from its first start on: everything that is stored there, most of it several times, much of it at once."""
    story.start()
    trained = story.upload(1)
    for version in (1, 2):
        story.train(ARM, trained, version)
    story.settings()
    for each in range(rounds):
        story.together(
            lambda at=each: _uploads(story, at), lambda: _observations(story), lambda at=each: _versions(story, at)
        )
        story.store()
    story.frames(60)
    story.make_key("guest")
    story.stop()
    story.start()
    shorter(story, rounds, serving=2)
    story.store()
    story.stop()


def _uploads(story: Story, number: int) -> None:
    dataset = story.upload(100 + 2 * number)
    story.upload_robot(f"robot-{number}")
    story.upload(101 + 2 * number)
    story.delete_dataset(f"recording-{100 + 2 * number}", dataset)


def _observations(story: Story) -> None:
    taught = [story.observe() for _ in range(8)]
    story.unlearn(taught[3][0])
    story.rollback(taught[5][1], [each for each, _ in taught[6:]])
    story.observe()


def _versions(story: Story, number: int) -> None:
    for version in (1, 2):
        story.point("production", version)
    story.publish(f"imported-{number}", 1)
    story.serve(1)
    story.publish(f"imported-{number}", 2)
    story.delete_version(f"imported-{number}", 2)
    story.serve(2)
    story.remove_alias("production")
    story.delete_model(f"imported-{number}", 1)


def shorter(story: Story, number: int, serving: int = 1) -> None:
    """Some of each kind, one after the other; serving: the version that does at the beginning and at the end."""
    dataset = story.upload(100 + 2 * number)
    story.upload_robot(f"robot-{number}")
    taught = [story.observe() for _ in range(4)]
    story.point("production", 2)
    story.publish(f"imported-{number}", 1)
    story.serve(3 - serving)
    story.unlearn(taught[1][0])
    story.delete_dataset(f"recording-{100 + 2 * number}", dataset)
    story.serve(serving)
    story.delete_model(f"imported-{number}", 1)


def upgrade(story: Story) -> None:
    """A home of an earlier release is migrated, and used."""
    story.start("migration")
    dataset = story.upload(1)
    story.upload_robot("robot")
    story.make_key("guest")
    story.delete_dataset("recording-1", dataset)
    story.kill()
    story.start("migration")
    story.upload(2)
    story.stop()


FILE = "*/lipserve.sqlite3"


def failing(story: Story, dataset: str) -> None:
    """Syncs fail at all kinds of requests, which are asked for again; then the service is killed and goes on."""
    refuse = story.refuse
    for number, pattern in enumerate(["*.draft", "*/datasets", f"{FILE}-wal"]):
        refuse(pattern, lambda at=number: story.upload(300 + at))
        story.upload(300 + number)
    refuse(f"{FILE}-wal", lambda: story.upload_robot("late"))
    refuse(f"{FILE}-wal", lambda: story.delete_dataset("recording-299", dataset))
    for number, pattern in enumerate(["*/model.safetensors", "*/.draft-mv_*", "*/versions", f"{FILE}-wal"]):
        refuse(pattern, lambda at=number: story.publish(f"late-{at}", 1))
        story.publish(f"late-{number}", 1)
    taught, _ = story.observe()
    for number in range(taught + 1, taught + 5):
        refuse(f"{FILE}-wal", lambda at=number: story.observe(at))
        refuse(f"{FILE}-wal", lambda: story.unlearn(taught))
        assert story.observe()[0] == number
    for ask in (lambda: story.point("production", 2), lambda: story.serve(2), lambda: story.serve(2)):
        refuse(f"{FILE}-wal", ask)
    story.kill()
    story.start()
    shorter(story, 900, story.look())
    story.kill()
    story.start()
    story.observe()
    story.kill()
