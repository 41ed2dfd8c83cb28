"""Requests that a fault interrupts. Each records its effect in the ledger."""

from abc import ABC, abstractmethod

import numpy as np

from service.models.archive import MEDIA_TYPE
from tests.service.data import ENDLESS, QUICK, arrays, eventually, npz, running, stream
from tests.service.robots.test_robots import urdf
from tests.system.faults.harness import FaultHarness
from tests.system.faults.injection import TIMEOUT_S
from tests.system.faults.ledger import ARM, STREAM_ID, batch, list_items, query_rows

ALIAS = "production"


class Action(ABC):
    """A request. name: of the resource that it is about, once it is known."""

    name = ""

    @abstractmethod
    def request(self, harness: FaultHarness) -> None:
        """Send the request, and record its effect if a response arrives."""

    @abstractmethod
    def check_outcome(self, harness: FaultHarness) -> bool:
        """Return whether an unanswered request has taken effect, and record it if so."""


class Upload(Action):
    """Upload a recording."""

    path, kind = "/v1/datasets", "application/x-npz"

    def entries(self, harness: FaultHarness) -> dict[str, dict]:
        """Return the ledger's entries of this kind, by id."""
        return harness.ledger.datasets

    def body(self, harness: FaultHarness) -> bytes:
        """Return the request body."""
        samples = stream(samples=60, seed=100 + len(harness.ledger.datasets))
        return npz(**arrays(samples), joint_names=np.array(samples.joint_names))

    def request(self, harness: FaultHarness) -> None:
        self.name = f"upload-{harness.next_number()}"
        headers, params = {"content-type": self.kind}, {"name": self.name}
        answer = harness.client.post(self.path, content=self.body(harness), headers=headers, params=params)
        assert answer.status_code == 201, answer.text
        self.entries(harness)[answer.json()["id"]] = answer.json()

    def check_outcome(self, harness: FaultHarness) -> bool:
        found = [each for each in list_items(harness.client, self.path) if each["name"] == self.name]
        self.entries(harness).update({each["id"]: each for each in found})
        return len(found) == 1


class UploadRobot(Upload):
    """Upload a URDF."""

    path, kind = "/v1/robots", "application/xml"

    def entries(self, harness: FaultHarness) -> dict[str, dict]:
        return harness.ledger.robots

    def body(self, harness: FaultHarness) -> bytes:
        return urdf(self.name)


class DeleteDataset(Action):
    """Delete a data set that was uploaded for this purpose."""

    def request(self, harness: FaultHarness) -> None:
        Upload().request(harness)
        self.name = list(harness.ledger.datasets)[-1]
        assert harness.client.delete(f"/v1/datasets/{self.name}").status_code == 204
        del harness.ledger.datasets[self.name]

    def check_outcome(self, harness: FaultHarness) -> bool:
        gone = harness.client.get(f"/v1/datasets/{self.name}").status_code == 404
        if gone:
            del harness.ledger.datasets[self.name]
        return gone


class Train(Action):
    """Train a new model."""

    def request(self, harness: FaultHarness) -> None:
        if not harness.ledger.datasets:
            Upload().request(harness)
        self.name = f"model-{harness.next_number()}"
        self.expect_job(harness, _queue_job(harness, self.name, next(iter(harness.ledger.datasets)), QUICK))

    def check_outcome(self, harness: FaultHarness) -> bool:
        found = [each["id"] for each in list_items(harness.client, "/v1/jobs") if each["model"] == self.name]
        assert len(found) <= 1
        for job in found:
            self.expect_job(harness, job)
        return len(found) == 1

    def expect_job(self, harness: FaultHarness, job: str) -> None:
        """Record that a job is expected to succeed."""
        harness.ledger.jobs[job] = "succeeded"
        harness.ledger.models.add(self.name)


class Cancel(Action):
    """Cancel a running job."""

    def request(self, harness: FaultHarness) -> None:
        body, headers = npz(**arrays(stream("panda", 150))), {"content-type": Upload.kind}
        dataset = harness.client.post(Upload.path, content=body, headers=headers).json()
        harness.ledger.datasets[dataset["id"]] = dataset
        self.name = _queue_job(harness, f"cancelled-{harness.next_number()}", dataset["id"], ENDLESS)
        harness.ledger.jobs[self.name] = "cancelled"
        running(harness.client, self.name)
        self.cancel(harness)

    def check_outcome(self, harness: FaultHarness) -> bool:
        done = harness.client.get(f"/v1/jobs/{self.name}").json()["state"] == "cancelled"
        if not done:
            self.cancel(harness)
        return done

    def cancel(self, harness: FaultHarness) -> None:
        """Send the cancellation."""
        assert harness.client.post(f"/v1/jobs/{self.name}/cancel").status_code == 200


def _queue_job(harness: FaultHarness, model: str, dataset: str, options: dict) -> str:
    wanted = {
        "model": model,
        "datasets": [dataset],
        "options": options,
        "estimator": "lip-chain",
        "promotion": "always",
    }
    answer = harness.client.post("/v1/jobs", json=wanted)
    assert answer.status_code == 202, answer.text
    return answer.json()["id"]


class Observe(Action):
    """Send an observation batch."""

    def request(self, harness: FaultHarness) -> None:
        self.sequence = max(harness.ledger.batches, default=-1) + 1
        assert not self.send(harness)

    def check_outcome(self, harness: FaultHarness) -> bool:
        return self.send(harness)  # send again, as a client does

    def send(self, harness: FaultHarness) -> bool:
        """Send the batch; return whether the service reports a duplicate."""
        answer = harness.client.post(f"/v1/models/{ARM}/observations", json=batch(self.sequence))
        assert answer.status_code == 200, answer.text
        harness.ledger.batches[self.sequence] = "learnt"
        return answer.json()["duplicate"]


class ObserveOn(Observe):
    """Send batches until the fault happens, each after the one before is in a snapshot."""

    def request(self, harness: FaultHarness) -> None:
        while harness.injector.happened() is None:
            super().request(harness)
            eventually(lambda: harness.injector.happened() or _is_stored(harness), TIMEOUT_S)


def _is_stored(harness: FaultHarness) -> bool:
    """Return whether a snapshot contains every event of the model."""
    newest = "SELECT max(number) FROM {} WHERE model = ?"
    return query_rows(harness.home, newest.format("snapshots"), ARM) == query_rows(
        harness.home, newest.format("events"), ARM
    )


class Unlearn(Action):
    """Unlearn a batch that was learnt before."""

    def request(self, harness: FaultHarness) -> None:
        Observe().request(harness)
        self.sequence = max(harness.ledger.batches)
        answer = harness.client.delete(f"/v1/models/{ARM}/observations/{STREAM_ID}/{self.sequence}")
        assert answer.status_code == 200, answer.text
        harness.ledger.batches[self.sequence] = "unlearnt"

    def check_outcome(self, harness: FaultHarness) -> bool:
        found = harness.client.get(f"/v1/models/{ARM}/observations/{STREAM_ID}/{self.sequence}").json()["state"]
        harness.ledger.batches[self.sequence] = found
        return found == "unlearnt"


class Serve(Action):
    """Change the serving version."""

    def request(self, harness: FaultHarness) -> None:
        self.version = 3 - harness.ledger.serving
        answer = harness.client.post(f"/v1/models/{ARM}/rollback", json={"version": self.version})
        assert answer.status_code == 200, answer.text
        harness.ledger.serving = self.version

    def check_outcome(self, harness: FaultHarness) -> bool:
        harness.ledger.serving = harness.client.get(f"/v1/models/{ARM}").json()["serving_version"]
        return harness.ledger.serving == self.version


class PointAlias(Action):
    """Move an alias to the other version; create it the first time."""

    def request(self, harness: FaultHarness) -> None:
        self.version: int | None = 3 - harness.ledger.aliases.get(ALIAS, 1)
        answer = harness.client.put(f"/v1/models/{ARM}/aliases/{ALIAS}", json={"version": self.version})
        assert answer.status_code == 200, answer.text
        harness.ledger.aliases[ALIAS] = self.version

    def check_outcome(self, harness: FaultHarness) -> bool:
        found = {each["alias"]: each["version"] for each in list_items(harness.client, f"/v1/models/{ARM}/aliases")}
        harness.ledger.aliases = {name: version for name, version in found.items() if name != "serving"}
        return found.get(ALIAS) == self.version


class RemoveAlias(PointAlias):
    """Remove the alias."""

    def request(self, harness: FaultHarness) -> None:
        super().request(harness)
        self.version = None
        assert harness.client.delete(f"/v1/models/{ARM}/aliases/{ALIAS}").status_code == 204
        del harness.ledger.aliases[ALIAS]


class ImportModel(Action):
    """Import an archive of a version as a new model."""

    def request(self, harness: FaultHarness) -> None:
        self.name = f"imported-{harness.next_number()}"
        self.import_version(harness)

    def check_outcome(self, harness: FaultHarness) -> bool:
        found = self.is_there(harness)
        if found:
            harness.ledger.imported[self.name] = [1]
        return found

    def import_version(self, harness: FaultHarness) -> None:
        """Import the next version."""
        archive = harness.client.get(f"/v1/models/{ARM}/export", params={"version": 2, "learnt": False})
        assert archive.status_code == 200, archive.text
        headers, params = {"content-type": MEDIA_TYPE}, {"name": self.name}
        answer = harness.client.post("/v1/models/import", content=archive.content, headers=headers, params=params)
        assert answer.status_code == 201, answer.text
        harness.ledger.imported.setdefault(self.name, []).append(answer.json()["version"])

    def is_there(self, harness: FaultHarness, path: str = "") -> bool:
        """Return whether the model, or a resource below it, exists."""
        return harness.client.get(f"/v1/models/{self.name}{path}").status_code == 200


class DeleteVersion(ImportModel):
    """Delete the first version of an imported model: the second one serves."""

    def request(self, harness: FaultHarness) -> None:
        super().request(harness)
        self.import_version(harness)
        assert harness.client.delete(f"/v1/models/{self.name}/versions/1").status_code == 204
        harness.ledger.imported[self.name] = [2]

    def check_outcome(self, harness: FaultHarness) -> bool:
        left = self.is_there(harness, "/versions/1")
        harness.ledger.imported[self.name] = [1, 2] if left else [2]
        return not left


class DeleteModel(ImportModel):
    """Delete an imported model."""

    def request(self, harness: FaultHarness) -> None:
        super().request(harness)
        assert harness.client.delete(f"/v1/models/{self.name}").status_code == 204
        del harness.ledger.imported[self.name]

    def check_outcome(self, harness: FaultHarness) -> bool:
        left = self.is_there(harness)
        if not left:
            del harness.ledger.imported[self.name]
        return not left
