"""What a service has acknowledged, and whether a service knows all of it: no less, nothing half, and nothing twice."""

import hashlib
import sqlite3
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np

import lipcore
from lipcore.data import independence
from lipcore.online.batch import Rows
from lipcore.online.learner import OnlineModel
from lipcore.vocabulary import Code
from lipserve.states import ACTIVE
from tests.service.data import eventually, job, stream
from tests.service.faults.injection import PATIENCE

ARM, SOURCE = "arm", "robot-1"
"""The model that learns, and where its observations come from."""
ROWS, RATE = 10, 100.0
"""Of a batch; rows a second."""
CLOSE = 1e-7
"""Largest difference of torques from those of a model that learnt the same rows at once, of the largest torque."""
QUERIES = {name: getattr(stream(seed=11, samples=20), name).tolist() for name in ("q", "dq", "ddq")}


def batch(sequence: int) -> dict[str, Any]:
    """The observation batch of a sequence: rows of one recording, one batch after the other."""
    taught = stream(seed=21, samples=3000, viscous=2.0)
    part = slice(sequence * ROWS, (sequence + 1) * ROWS)
    body = {name: getattr(taught, name)[part].tolist() for name in ("q", "dq", "ddq", "tau")}
    return {"stream_id": SOURCE, "sequence": sequence, "t": (np.arange(part.start, part.stop) / RATE).tolist(), **body}


@dataclass
class Ledger:
    """What was acknowledged.

    datasets, robots: answers by id; jobs: how each ends; models: that jobs have made; batches: what became of each
    sequence; serving: version that answers; aliases: where they point; imported: versions of models that were imported.
    """

    datasets: dict[str, dict[str, Any]] = field(default_factory=dict)
    robots: dict[str, dict[str, Any]] = field(default_factory=dict)
    jobs: dict[str, str] = field(default_factory=dict)
    models: set[str] = field(default_factory=set)
    batches: dict[int, str] = field(default_factory=dict)
    serving: int = 1
    aliases: dict[str, int] = field(default_factory=dict)
    imported: dict[str, list[int]] = field(default_factory=dict)

    def verify(self, client: httpx.Client, home: Path, arm: bool = True) -> None:
        """Compare with what a service knows, on a home with the model ARM or without; fail where they differ."""
        eventually(lambda: client.get("/health/ready").status_code == 200, PATIENCE)  # what was killed is started again
        self._verify_uploads(client, home)
        self._verify_jobs(client)
        self._verify_versions(client, arm)
        if arm:
            self._verify_learning(client, home)
        verify_files(home)
        verify_database(home)

    def _verify_uploads(self, client: httpx.Client, home: Path) -> None:
        found = {each["id"]: each for each in listed(client, "/v1/datasets")}
        assert found == self.datasets
        for name, each in found.items():
            payload = (home / "datasets" / f"{name}.safetensors").read_bytes()
            assert hashlib.sha256(payload).hexdigest() == each["sha256"]
        assert {each["id"]: each for each in listed(client, "/v1/robots")} == self.robots

    def _verify_jobs(self, client: httpx.Client) -> None:
        assert {each["id"] for each in listed(client, "/v1/jobs")} == set(self.jobs)
        for name, state in self.jobs.items():
            seen = eventually(lambda at=name: (found := job(client, at))["state"] not in ACTIVE and found, PATIENCE)
            assert seen["state"] == state, seen
            assert (seen["model"] in self.models) == (state == "succeeded")

    def _verify_versions(self, client: httpx.Client, arm: bool) -> None:
        """Each version answers, and no job has made two."""
        models = {each["name"]: each for each in listed(client, "/v1/models")}
        assert set(models) == self.models | self.imported.keys() | {"panda-sim"} | ({ARM} if arm else set())
        made: list[str] = []
        for name, model in models.items():
            versions = [each["version"] for each in model["versions"]]
            assert versions == ([1, 2] if name == ARM else self.imported.get(name, [1]))
            if name == "panda-sim":
                continue
            for each in model["versions"]:
                answer = predicted(client, name, each["version"])
                assert np.isfinite([answer["tau"], answer["tau_std"]]).all()
                made += filter(None, [client.get(f"/v1/models/{name}/versions/{each['version']}").json()["job"]])
        assert sorted(made) == sorted(name for name, state in self.jobs.items() if state == "succeeded")
        if not arm:
            return
        assert models[ARM]["serving_version"] == self.serving
        assert predicted(client, ARM)["version"] == self.serving
        aliases = {each["alias"]: each["version"] for each in listed(client, f"/v1/models/{ARM}/aliases")}
        assert aliases == {"serving": self.serving, **self.aliases}
        for alias, version in aliases.items():
            assert predicted(client, ARM, alias=alias)["version"] == version

    def _verify_learning(self, client: httpx.Client, home: Path) -> None:
        """All batches are known, none is there twice, and what is learnt is what they teach."""
        for sequence, state in self.batches.items():
            answer = client.post(f"/v1/models/{ARM}/observations", json=batch(sequence))
            assert answer.status_code == 200, answer.text
            assert (answer.json()["duplicate"], answer.json()["state"]) == (True, state)
        query = "SELECT sequence FROM events WHERE model = ? AND kind = 'batch' ORDER BY sequence"
        assert [row[0] for row in rows(home, query, ARM)] == sorted(self.batches)
        numbers = [row[0] for row in rows(home, "SELECT number FROM events WHERE model = ? ORDER BY number", ARM)]
        assert numbers == list(range(1, len(numbers) + 1))
        if self.batches:
            start = rows(home, "SELECT start FROM learners WHERE model = ? AND version = ?", ARM, self.serving)[0][0]
            served = eventually(
                lambda: (seen := predicted(client, ARM))["revision"] >= numbers[-1] - start and seen, PATIENCE
            )
            expected = self.learnt(home).tau
            assert np.abs(np.array(served["tau"]) - expected).max() <= CLOSE * np.abs(expected).max()

    def learnt(self, home: Path) -> Any:
        """What a model predicts that has learnt, in one go, all batches that teach."""
        query = "SELECT folder FROM versions WHERE model = ? AND version = 1"
        base = lipcore.load(home / "versions" / rows(home, query, ARM)[0][0])
        taught = stream(seed=21, samples=3000, viscous=2.0)
        times = np.arange(len(taught)) / RATE
        last = (max(self.batches) + 1) * ROWS
        teach = [s for s, state in sorted(self.batches.items()) if state == "learnt"]
        places = np.concatenate([np.arange(s * ROWS, (s + 1) * ROWS) for s in teach] or [np.arange(0)])
        numbers = [getattr(taught, name)[:last] for name in ("q", "dq", "ddq", "tau")]
        code = np.full(last, Code.LEARNT, np.uint8)
        every = Rows(times[:last], *numbers, code, independence.even_weights(times[:last]))
        model = OnlineModel.start(base).learn(every.take(places)).model()
        return model.predict(*(np.array(QUERIES[name]) for name in ("q", "dq", "ddq")))


def verify_files(home: Path) -> None:
    """The home has the files that rows name, and no others: not even for a while, but for what is being written."""
    for folder, query in (
        ("datasets", "SELECT id || '.safetensors' FROM datasets"),
        ("versions", "SELECT folder FROM versions"),
        ("learning", "SELECT id || '.safetensors' FROM snapshots"),
        ("uploads", "SELECT id FROM datasets WHERE 0"),
    ):
        eventually(lambda at=home / folder, by=query: names(at) == {row[0] for row in rows(home, by)}, PATIENCE / 5)


def verify_database(home: Path) -> None:
    """SQLite finds nothing wrong."""
    assert rows(home, "PRAGMA integrity_check") == [("ok",)]
    assert rows(home, "PRAGMA foreign_key_check") == []


def names(folder: Path) -> set[str]:
    """Files and folders in a folder, but for that of publications, which live for a moment."""
    return {path.name for path in folder.iterdir()} - {"published"}


def rows(home: Path, query: str, *values: Any) -> list[tuple[Any, ...]]:
    """What a query finds in the database of a home."""
    with closing(sqlite3.connect(f"file:{home / 'lipserve.sqlite3'}?mode=ro", uri=True, timeout=30.0)) as database:
        return database.execute(query, values).fetchall()


def listed(client: httpx.Client, path: str) -> list[dict[str, Any]]:
    """All items of a list."""
    items: list[dict[str, Any]] = []
    cursor: str | None = None
    while True:
        answer = client.get(path, params={} if cursor is None else {"cursor": cursor})
        assert answer.status_code == 200, answer.text
        items += answer.json()["items"]
        if (cursor := answer.json()["next_cursor"]) is None:
            return items


def predicted(client: httpx.Client, model: str, version: int | None = None, **more: Any) -> dict[str, Any]:
    """What a model answers to QUERIES."""
    wanted = {} if version is None else {"version": version}
    answer = client.post(f"/v1/models/{model}/predict", json=QUERIES | wanted | more)
    assert answer.status_code == 200, answer.text
    return answer.json()
