"""What is asked of a service while a fault strikes, and whether it has taken effect: both enter it in the ledger."""

from abc import ABC, abstractmethod

import numpy as np

from service.models.archive import MEDIA_TYPE
from tests.service.data import ENDLESS, QUICK, arrays, eventually, npz, running, stream
from tests.service.faults.house import House
from tests.service.faults.injection import PATIENCE
from tests.service.faults.ledger import ARM, SOURCE, batch, listed, rows
from tests.service.test_robots import urdf

ALIAS = "production"


class Action(ABC):
    """One thing that is asked for. name: of what it is about, as soon as that is known."""

    name = ""

    @abstractmethod
    def ask(self, house: House) -> None:
        """Ask for it; enter it in the ledger where it is answered."""

    @abstractmethod
    def settle(self, house: House) -> bool:
        """Whether it has taken effect though it was not answered: look, and enter it then."""


class Upload(Action):
    """Upload a recording."""

    path, kind = "/v1/datasets", "application/x-npz"

    def entries(self, house: House) -> dict[str, dict]:
        """Where the ledger has them, by id."""
        return house.ledger.datasets

    def body(self, house: House) -> bytes:
        """What is uploaded."""
        samples = stream(samples=60, seed=100 + len(house.ledger.datasets))
        return npz(**arrays(samples), joint_names=np.array(samples.joint_names))

    def ask(self, house: House) -> None:
        self.name = f"upload-{house.number()}"
        headers, params = {"content-type": self.kind}, {"name": self.name}
        answer = house.client.post(self.path, content=self.body(house), headers=headers, params=params)
        assert answer.status_code == 201, answer.text
        self.entries(house)[answer.json()["id"]] = answer.json()

    def settle(self, house: House) -> bool:
        found = [each for each in listed(house.client, self.path) if each["name"] == self.name]
        self.entries(house).update({each["id"]: each for each in found})
        return len(found) == 1


class UploadRobot(Upload):
    """Upload a URDF."""

    path, kind = "/v1/robots", "application/xml"

    def entries(self, house: House) -> dict[str, dict]:
        return house.ledger.robots

    def body(self, house: House) -> bytes:
        return urdf(self.name)


class DeleteDataset(Action):
    """Delete a data set that was uploaded before."""

    def ask(self, house: House) -> None:
        Upload().ask(house)
        self.name = list(house.ledger.datasets)[-1]
        assert house.client.delete(f"/v1/datasets/{self.name}").status_code == 204
        del house.ledger.datasets[self.name]

    def settle(self, house: House) -> bool:
        gone = house.client.get(f"/v1/datasets/{self.name}").status_code == 404
        if gone:
            del house.ledger.datasets[self.name]
        return gone


class Train(Action):
    """Train a model of a name of its own."""

    def ask(self, house: House) -> None:
        if not house.ledger.datasets:
            Upload().ask(house)
        self.name = f"model-{house.number()}"
        self.enter(house, _queued(house, self.name, next(iter(house.ledger.datasets)), QUICK))

    def settle(self, house: House) -> bool:
        found = [each["id"] for each in listed(house.client, "/v1/jobs") if each["model"] == self.name]
        assert len(found) <= 1
        for job in found:
            self.enter(house, job)
        return len(found) == 1

    def enter(self, house: House, job: str) -> None:
        """Expect a job to make its model."""
        house.ledger.jobs[job] = "succeeded"
        house.ledger.models.add(self.name)


class Cancel(Action):
    """Cancel a job that runs."""

    def ask(self, house: House) -> None:
        body, headers = npz(**arrays(stream("panda", 150))), {"content-type": Upload.kind}
        dataset = house.client.post(Upload.path, content=body, headers=headers).json()
        house.ledger.datasets[dataset["id"]] = dataset
        self.name = _queued(house, f"cancelled-{house.number()}", dataset["id"], ENDLESS)
        house.ledger.jobs[self.name] = "cancelled"
        running(house.client, self.name)
        self.cancel(house)

    def settle(self, house: House) -> bool:
        done = house.client.get(f"/v1/jobs/{self.name}").json()["state"] == "cancelled"
        if not done:
            self.cancel(house)
        return done

    def cancel(self, house: House) -> None:
        """Ask for it once."""
        assert house.client.post(f"/v1/jobs/{self.name}/cancel").status_code == 200


def _queued(house: House, model: str, dataset: str, options: dict) -> str:
    wanted = {
        "model": model,
        "datasets": [dataset],
        "options": options,
        "estimator": "lip-chain",
        "promotion": "always",
    }
    answer = house.client.post("/v1/jobs", json=wanted)
    assert answer.status_code == 202, answer.text
    return answer.json()["id"]


class Observe(Action):
    """Teach a batch."""

    def ask(self, house: House) -> None:
        self.sequence = max(house.ledger.batches, default=-1) + 1
        assert not self.sent(house)

    def settle(self, house: House) -> bool:
        return self.sent(house)  # again, as a robot would

    def sent(self, house: House) -> bool:
        """Send it; return whether it was known."""
        answer = house.client.post(f"/v1/models/{ARM}/observations", json=batch(self.sequence))
        assert answer.status_code == 200, answer.text
        house.ledger.batches[self.sequence] = "learnt"
        return answer.json()["duplicate"]


class ObserveOn(Observe):
    """Teach batches, each once the one before is stored, until the fault happens."""

    def ask(self, house: House) -> None:
        while house.injector.happened() is None:
            super().ask(house)
            eventually(lambda: house.injector.happened() or _stored(house), PATIENCE)


def _stored(house: House) -> bool:
    """Whether a snapshot contains all that the model has observed."""
    newest = "SELECT max(number) FROM {} WHERE model = ?"
    return rows(house.home, newest.format("snapshots"), ARM) == rows(house.home, newest.format("events"), ARM)


class Unlearn(Action):
    """Take a batch back that was learnt before."""

    def ask(self, house: House) -> None:
        Observe().ask(house)
        self.sequence = max(house.ledger.batches)
        answer = house.client.delete(f"/v1/models/{ARM}/observations/{SOURCE}/{self.sequence}")
        assert answer.status_code == 200, answer.text
        house.ledger.batches[self.sequence] = "unlearnt"

    def settle(self, house: House) -> bool:
        found = house.client.get(f"/v1/models/{ARM}/observations/{SOURCE}/{self.sequence}").json()["state"]
        house.ledger.batches[self.sequence] = found
        return found == "unlearnt"


class Serve(Action):
    """Let the other version answer."""

    def ask(self, house: House) -> None:
        self.version = 3 - house.ledger.serving
        answer = house.client.post(f"/v1/models/{ARM}/rollback", json={"version": self.version})
        assert answer.status_code == 200, answer.text
        house.ledger.serving = self.version

    def settle(self, house: House) -> bool:
        house.ledger.serving = house.client.get(f"/v1/models/{ARM}").json()["serving_version"]
        return house.ledger.serving == self.version


class PointAlias(Action):
    """Let an alias point to the other version; the first time it is new."""

    def ask(self, house: House) -> None:
        self.version: int | None = 3 - house.ledger.aliases.get(ALIAS, 1)
        answer = house.client.put(f"/v1/models/{ARM}/aliases/{ALIAS}", json={"version": self.version})
        assert answer.status_code == 200, answer.text
        house.ledger.aliases[ALIAS] = self.version

    def settle(self, house: House) -> bool:
        found = {each["alias"]: each["version"] for each in listed(house.client, f"/v1/models/{ARM}/aliases")}
        house.ledger.aliases = {name: version for name, version in found.items() if name != "serving"}
        return found.get(ALIAS) == self.version


class RemoveAlias(PointAlias):
    """Remove that alias."""

    def ask(self, house: House) -> None:
        super().ask(house)
        self.version = None
        assert house.client.delete(f"/v1/models/{ARM}/aliases/{ALIAS}").status_code == 204
        del house.ledger.aliases[ALIAS]


class ImportModel(Action):
    """Import an archive of a version as a model of its own."""

    def ask(self, house: House) -> None:
        self.name = f"imported-{house.number()}"
        self.imported(house)

    def settle(self, house: House) -> bool:
        found = self.is_there(house)
        if found:
            house.ledger.imported[self.name] = [1]
        return found

    def imported(self, house: House) -> None:
        """Import another version."""
        archive = house.client.get(f"/v1/models/{ARM}/export", params={"version": 2, "learnt": False})
        assert archive.status_code == 200, archive.text
        headers, params = {"content-type": MEDIA_TYPE}, {"name": self.name}
        answer = house.client.post("/v1/models/import", content=archive.content, headers=headers, params=params)
        assert answer.status_code == 201, answer.text
        house.ledger.imported.setdefault(self.name, []).append(answer.json()["version"])

    def is_there(self, house: House, path: str = "") -> bool:
        """Whether the model, or something of it, is known."""
        return house.client.get(f"/v1/models/{self.name}{path}").status_code == 200


class DeleteVersion(ImportModel):
    """Delete the second version of an imported model."""

    def ask(self, house: House) -> None:
        super().ask(house)
        self.imported(house)
        assert house.client.delete(f"/v1/models/{self.name}/versions/2").status_code == 204
        house.ledger.imported[self.name] = [1]

    def settle(self, house: House) -> bool:
        left = self.is_there(house, "/versions/2")
        house.ledger.imported[self.name] = [1, 2] if left else [1]
        return not left


class DeleteModel(ImportModel):
    """Delete an imported model."""

    def ask(self, house: House) -> None:
        super().ask(house)
        assert house.client.delete(f"/v1/models/{self.name}").status_code == 204
        del house.ledger.imported[self.name]

    def settle(self, house: House) -> bool:
        left = self.is_there(house)
        if not left:
            del house.ledger.imported[self.name]
        return not left
