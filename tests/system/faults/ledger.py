"""The writes that a service has acknowledged, and checks that it has all of them, whole and once."""

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
from service.cli.verify import verify_home
from service.foundation.settings import Settings
from tests.service.data import eventually, job, stream
from tests.system.faults.injection import TIMEOUT_S

ARM, STREAM_ID = "arm", "robot-1"
"""The model that learns, and the stream of its observations."""
ROWS, RATE = 10, 100.0
"""Rows of a batch; rows per second."""
MAX_RELATIVE_DIFFERENCE = 1e-7
"""Largest difference from a model that learnt the same rows at once, relative to the largest torque."""
QUERIES = {name: getattr(stream(seed=11, samples=20), name).tolist() for name in ("q", "dq", "ddq")}


def batch(sequence: int) -> dict[str, Any]:
    """Return the observation batch of a sequence; batches follow each other in one recording."""
    samples = stream(seed=21, samples=3000, viscous=2.0)
    part = slice(sequence * ROWS, (sequence + 1) * ROWS)
    body = {name: getattr(samples, name)[part].tolist() for name in ("q", "dq", "ddq", "tau")}
    return {
        "stream_id": STREAM_ID,
        "sequence": sequence,
        "t": (np.arange(part.start, part.stop) / RATE).tolist(),
        **body,
    }


FOLDERS = {
    "datasets": "SELECT id || '.safetensors' FROM datasets UNION SELECT id || '.recording' FROM datasets "
    "WHERE json_extract(report, '$.upload_options') IS NOT NULL",
    "versions": "SELECT folder FROM versions",
    "learning": "SELECT id || '.safetensors' FROM snapshots",
    "uploads": "SELECT id FROM datasets WHERE 0",
}
"""Folders of a home, and queries of the files that rows name."""


@dataclass
class Ledger:
    """Acknowledged writes.

    datasets, robots: responses by id; jobs: the expected final state of each; models: names that jobs have trained;
    batches: state of each sequence; serving: serving version; aliases: version of each; imported: versions of imported
    models.
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
        """Compare with the state of a service; `arm` tells whether its home has the model ARM."""
        eventually(
            lambda: client.get("/health/ready").status_code == 200, TIMEOUT_S
        )  # killed processes are restarted first
        self._verify_uploads(client)
        self._verify_jobs(client)
        self._verify_versions(client, arm)
        if arm:
            self._verify_learning(client, home)
        verify_files(home)
        assert verify_home(Settings(home=home)).damages == []

    def _verify_uploads(self, client: httpx.Client) -> None:
        found = {each["id"]: each for each in list_items(client, "/v1/datasets")}
        assert found == self.datasets  # `verify` compares the files with the sha256 of the database
        assert {each["id"]: each for each in list_items(client, "/v1/robots")} == self.robots

    def _verify_jobs(self, client: httpx.Client) -> None:
        assert {each["id"] for each in list_items(client, "/v1/jobs")} == set(self.jobs)
        for name, state in self.jobs.items():
            seen = eventually(lambda at=name: (found := job(client, at))["state"] not in ACTIVE and found, TIMEOUT_S)
            assert seen["state"] == state, seen
            assert (seen["model"] in self.models) == (state == "succeeded")

    def _verify_versions(self, client: httpx.Client, arm: bool) -> None:
        """Check that each version answers, and that no job has published two."""
        models = {each["name"]: each for each in list_items(client, "/v1/models")}
        assert set(models) == self.models | self.imported.keys() | {"panda-sim"} | ({ARM} if arm else set())
        made: list[str] = []
        for name, model in models.items():
            versions = [each["version"] for each in model["versions"]]
            assert versions == ([1, 2] if name == ARM else self.imported.get(name, [1]))
            if name == "panda-sim":
                continue
            for each in model["versions"]:
                answer = predict_queries(client, name, each["version"])
                assert np.isfinite([answer["tau"], answer["tau_std"]]).all()
                made += filter(None, [client.get(f"/v1/models/{name}/versions/{each['version']}").json()["job"]])
        assert sorted(made) == sorted(name for name, state in self.jobs.items() if state == "succeeded")
        if not arm:
            return
        assert models[ARM]["serving_version"] == self.serving
        assert predict_queries(client, ARM)["version"] == self.serving
        aliases = {each["alias"]: each["version"] for each in list_items(client, f"/v1/models/{ARM}/aliases")}
        assert aliases == {"serving": self.serving, **self.aliases}
        for alias, version in aliases.items():
            assert predict_queries(client, ARM, alias=alias)["version"] == version

    def _verify_learning(self, client: httpx.Client, home: Path) -> None:
        """Check that every batch is logged once, and that the serving model has learnt the learnt ones."""
        for sequence, state in self.batches.items():
            answer = client.post(f"/v1/models/{ARM}/observations", json=batch(sequence))
            assert answer.status_code == 200, answer.text
            assert (answer.json()["duplicate"], answer.json()["state"]) == (True, state)
        query = "SELECT sequence FROM events WHERE model = ? AND kind = 'batch' ORDER BY sequence"
        assert [row[0] for row in query_rows(home, query, ARM)] == sorted(self.batches)
        numbers = [row[0] for row in query_rows(home, "SELECT number FROM events WHERE model = ? ORDER BY number", ARM)]
        assert numbers == list(range(1, len(numbers) + 1))
        if self.batches:
            start = query_rows(home, "SELECT start FROM learners WHERE model = ? AND version = ?", ARM, self.serving)[
                0
            ][0]
            served = eventually(
                lambda: (seen := predict_queries(client, ARM))["revision"] >= numbers[-1] - start and seen, TIMEOUT_S
            )
            expected = self.predict_expected(home).tau
            assert np.abs(np.array(served["tau"]) - expected).max() <= MAX_RELATIVE_DIFFERENCE * np.abs(expected).max()

    def predict_expected(self, home: Path) -> Any:
        """Return the predictions of a model that learns all learnt batches at once."""
        query = "SELECT folder FROM versions WHERE model = ? AND version = 1"
        base = lipcore.load(home / "versions" / query_rows(home, query, ARM)[0][0])
        samples = stream(seed=21, samples=3000, viscous=2.0)
        times = np.arange(len(samples)) / RATE
        last = (max(self.batches) + 1) * ROWS
        learnt_sequences = [s for s, state in sorted(self.batches.items()) if state == "learnt"]
        places = np.concatenate([np.arange(s * ROWS, (s + 1) * ROWS) for s in learnt_sequences] or [np.arange(0)])
        numbers = [getattr(samples, name)[:last] for name in ("q", "dq", "ddq", "tau")]
        code = np.full(last, Code.LEARNT, np.uint8)
        every = Rows(times[:last], *numbers, code, independence.even_weights(times[:last]))
        model = OnlineModel.start(base).learn(every.take(places)).model()
        return model.predict(*(np.array(QUERIES[name]) for name in ("q", "dq", "ddq")))


def verify_files(home: Path) -> None:
    """Check that the home has exactly the files that rows name; temporary files may exist for a while."""
    for folder, query in FOLDERS.items():
        eventually(
            lambda at=home / folder, by=query: file_names(at) == {row[0] for row in query_rows(home, by)}, TIMEOUT_S / 5
        )


def file_names(folder: Path) -> set[str]:
    """Return the names in a folder, without the folder of publications, which are short-lived."""
    return {path.name for path in folder.iterdir()} - {"published"}


def query_rows(home: Path, query: str, *values: Any) -> list[tuple[Any, ...]]:
    """Return the result of a query on the database of a home."""
    with closing(sqlite3.connect(f"file:{home / 'lipserve.sqlite3'}?mode=ro", uri=True, timeout=30.0)) as database:
        return database.execute(query, values).fetchall()


def list_items(client: httpx.Client, path: str) -> list[dict[str, Any]]:
    """Return all items of a list, page by page."""
    items: list[dict[str, Any]] = []
    cursor: str | None = None
    while True:
        answer = client.get(path, params={} if cursor is None else {"cursor": cursor})
        assert answer.status_code == 200, answer.text
        items += answer.json()["items"]
        if (cursor := answer.json()["next_cursor"]) is None:
            return items


def predict_queries(client: httpx.Client, model: str, version: int | None = None, **more: Any) -> dict[str, Any]:
    """Return the predictions of a model for QUERIES."""
    wanted = {} if version is None else {"version": version}
    answer = client.post(f"/v1/models/{model}/predict", json=QUERIES | wanted | more)
    assert answer.status_code == 200, answer.text
    return answer.json()
