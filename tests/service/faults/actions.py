"""What is asked of a service while a fault strikes, and whether it has taken effect: both enter it in the ledger."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from service.models.archive import MEDIA_TYPE
from tests.service.data import ENDLESS, QUICK, arrays, eventually, npz, running, stream
from tests.service.faults.house import House
from tests.service.faults.injection import PATIENCE
from tests.service.faults.ledger import ARM, SOURCE, batch, listed, rows
from tests.service.test_robots import urdf

ALIAS = "production"


@dataclass
class Action:
    """One thing that is asked for. `ask` enters it in the ledger where it is answered; `settle` looks whether what was
    not answered has taken effect, enters it then, and says so."""

    ask: Callable[[House], None]
    settle: Callable[[House], bool]


def upload() -> Action:
    """Upload a recording."""
    name = []

    def ask(house: House) -> None:
        name.append(f"recording {house.number()}")
        samples = stream(samples=60, seed=100 + len(house.ledger.datasets))
        body = npz(**arrays(samples), joint_names=np.array(samples.joint_names))
        kind = {"content-type": "application/x-npz"}
        answer = house.client.post("/v1/datasets", content=body, headers=kind, params={"name": name[-1]})
        assert answer.status_code == 201, answer.text
        house.ledger.datasets[answer.json()["id"]] = answer.json()

    def settle(house: House) -> bool:
        found = [each for each in listed(house.client, "/v1/datasets") if each["name"] == name[-1]]
        house.ledger.datasets |= {each["id"]: each for each in found}
        return len(found) == 1

    return Action(ask, settle)


def upload_robot() -> Action:
    """Upload a URDF."""
    name = []

    def ask(house: House) -> None:
        name.append(f"robot-{house.number()}")
        kind = {"content-type": "application/xml"}
        answer = house.client.post("/v1/robots", content=urdf(name[-1]), headers=kind, params={"name": name[-1]})
        assert answer.status_code == 201, answer.text
        house.ledger.robots[answer.json()["id"]] = answer.json()

    def settle(house: House) -> bool:
        found = [each for each in listed(house.client, "/v1/robots") if each["name"] == name[-1]]
        house.ledger.robots |= {each["id"]: each for each in found}
        return len(found) == 1

    return Action(ask, settle)


def delete_dataset() -> Action:
    """Delete a data set that was uploaded before."""
    doomed = []

    def ask(house: House) -> None:
        upload().ask(house)
        doomed.append(list(house.ledger.datasets)[-1])
        assert house.client.delete(f"/v1/datasets/{doomed[0]}").status_code == 204
        del house.ledger.datasets[doomed[0]]

    def settle(house: House) -> bool:
        if house.client.get(f"/v1/datasets/{doomed[0]}").status_code != 404:
            return False
        del house.ledger.datasets[doomed[0]]
        return True

    return Action(ask, settle)


def train() -> Action:
    """Train a model of a name of its own."""
    model = []

    def ask(house: House) -> None:
        if not house.ledger.datasets:
            upload().ask(house)
        model.append(f"model-{house.number()}")
        wanted = {"model": model[0], "datasets": [next(iter(house.ledger.datasets))], "options": QUICK}
        wanted["estimator"] = "lip-chain"
        answer = house.client.post("/v1/jobs", json=wanted)
        assert answer.status_code == 202, answer.text
        house.ledger.jobs[answer.json()["id"]] = "succeeded"
        house.ledger.models.add(model[0])

    def settle(house: House) -> bool:
        found = [each["id"] for each in listed(house.client, "/v1/jobs") if each["model"] == model[0]]
        assert len(found) <= 1
        if found:
            house.ledger.jobs |= dict.fromkeys(found, "succeeded")
            house.ledger.models.add(model[0])
        return len(found) == 1

    return Action(ask, settle)


def observe() -> Action:
    """Teach a batch."""
    sequence = []

    def ask(house: House) -> None:
        sequence.append(max(house.ledger.batches, default=-1) + 1)
        answer = house.client.post(f"/v1/models/{ARM}/observations", json=batch(sequence[-1]))
        assert answer.status_code == 200, answer.text
        assert not answer.json()["duplicate"]
        house.ledger.batches[sequence[-1]] = "learnt"

    def settle(house: House) -> bool:
        answer = house.client.post(f"/v1/models/{ARM}/observations", json=batch(sequence[-1]))  # as a robot would
        assert answer.status_code == 200, answer.text
        house.ledger.batches[sequence[-1]] = "learnt"
        return answer.json()["duplicate"]

    return Action(ask, settle)


def observe_on() -> Action:
    """Teach batches, each once the one before is stored, until the fault happens."""
    latest = []

    def ask(house: House) -> None:
        while house.injector.happened() is None:
            latest.append(observe())
            latest[-1].ask(house)
            eventually(lambda: house.injector.happened() or _stored(house), PATIENCE)

    def settle(house: House) -> bool:
        return latest[-1].settle(house)

    return Action(ask, settle)


def _stored(house: House) -> bool:
    """Whether a snapshot contains all that the model has observed."""
    newest = "SELECT max(number) FROM {} WHERE model = ?"
    return rows(house.home, newest.format("snapshots"), ARM) == rows(house.home, newest.format("events"), ARM)


def unlearn() -> Action:
    """Take a batch back that was learnt before."""
    path = []

    def ask(house: House) -> None:
        observe().ask(house)
        path.append(max(house.ledger.batches))
        answer = house.client.delete(f"/v1/models/{ARM}/observations/{SOURCE}/{path[0]}")
        assert answer.status_code == 200, answer.text
        house.ledger.batches[path[0]] = "unlearnt"

    def settle(house: House) -> bool:
        found = house.client.get(f"/v1/models/{ARM}/observations/{SOURCE}/{path[0]}").json()["state"]
        house.ledger.batches[path[0]] = found
        return found == "unlearnt"

    return Action(ask, settle)


def serve() -> Action:
    """Let the other version answer."""
    wanted = []

    def ask(house: House) -> None:
        wanted.append(3 - house.ledger.serving)
        answer = house.client.post(f"/v1/models/{ARM}/rollback", json={"version": wanted[0]})
        assert answer.status_code == 200, answer.text
        house.ledger.serving = wanted[0]

    def settle(house: House) -> bool:
        found = house.client.get(f"/v1/models/{ARM}").json()["serving_version"]
        done = found == wanted[0]
        house.ledger.serving = found
        return done

    return Action(ask, settle)


def cancel() -> Action:
    """Cancel a job that runs."""
    job = []

    def ask(house: House) -> None:
        body, kind = npz(**arrays(stream("panda", 150))), {"content-type": "application/x-npz"}
        dataset = house.client.post("/v1/datasets", content=body, headers=kind).json()
        house.ledger.datasets[dataset["id"]] = dataset
        wanted = {"model": f"cancelled-{house.number()}", "datasets": [dataset["id"]], "options": ENDLESS}
        wanted["estimator"] = "lip-chain"
        job.append(house.client.post("/v1/jobs", json=wanted).json()["id"])
        house.ledger.jobs[job[0]] = "cancelled"
        running(house.client, job[0])
        assert house.client.post(f"/v1/jobs/{job[0]}/cancel").status_code == 200

    def settle(house: House) -> bool:
        if house.client.get(f"/v1/jobs/{job[0]}").json()["state"] == "cancelled":
            return True
        assert house.client.post(f"/v1/jobs/{job[0]}/cancel").status_code == 200
        return False

    return Action(ask, settle)


def point_alias() -> Action:
    """Let an alias point to the other version; the first time it is new."""
    wanted = []

    def ask(house: House) -> None:
        wanted.append(3 - house.ledger.aliases.get(ALIAS, 1))
        answer = house.client.put(f"/v1/models/{ARM}/aliases/{ALIAS}", json={"version": wanted[0]})
        assert answer.status_code == 200, answer.text
        house.ledger.aliases[ALIAS] = wanted[0]

    def settle(house: House) -> bool:
        return _find_alias(house) == wanted[0]

    return Action(ask, settle)


def remove_alias() -> Action:
    """Remove that alias."""

    def ask(house: House) -> None:
        point_alias().ask(house)
        assert house.client.delete(f"/v1/models/{ARM}/aliases/{ALIAS}").status_code == 204
        del house.ledger.aliases[ALIAS]

    def settle(house: House) -> bool:
        return _find_alias(house) is None

    return Action(ask, settle)


def _find_alias(house: House) -> int | None:
    """Where the alias points, entered in the ledger."""
    found = {each["alias"]: each["version"] for each in listed(house.client, f"/v1/models/{ARM}/aliases")}
    house.ledger.aliases = {name: version for name, version in found.items() if name != "serving"}
    return house.ledger.aliases.get(ALIAS)


def import_model() -> Action:
    """Import an archive of a version as a model of its own."""
    name = []

    def ask(house: House) -> None:
        name.append(f"imported-{house.number()}")
        _import(house, name[0])

    def settle(house: House) -> bool:
        found = house.client.get(f"/v1/models/{name[0]}").status_code == 200
        if found:
            house.ledger.imported[name[0]] = [1]
        return found

    return Action(ask, settle)


def delete_version() -> Action:
    """Delete the second version of an imported model."""
    name = []

    def ask(house: House) -> None:
        name.append(f"imported-{house.number()}")
        _import(house, name[0])
        _import(house, name[0])
        assert house.client.delete(f"/v1/models/{name[0]}/versions/2").status_code == 204
        house.ledger.imported[name[0]] = [1]

    def settle(house: House) -> bool:
        gone = house.client.get(f"/v1/models/{name[0]}/versions/2").status_code == 404
        house.ledger.imported[name[0]] = [1] if gone else [1, 2]
        return gone

    return Action(ask, settle)


def delete_model() -> Action:
    """Delete an imported model."""
    name = []

    def ask(house: House) -> None:
        name.append(f"imported-{house.number()}")
        _import(house, name[0])
        assert house.client.delete(f"/v1/models/{name[0]}").status_code == 204
        del house.ledger.imported[name[0]]

    def settle(house: House) -> bool:
        if house.client.get(f"/v1/models/{name[0]}").status_code == 200:
            return False
        del house.ledger.imported[name[0]]
        return True

    return Action(ask, settle)


def _import(house: House, name: str) -> None:
    archive = house.client.get(f"/v1/models/{ARM}/export", params={"version": 2, "learnt": False})
    assert archive.status_code == 200, archive.text
    answer = house.client.post(
        "/v1/models/import", content=archive.content, headers={"content-type": MEDIA_TYPE}, params={"name": name}
    )
    assert answer.status_code == 201, answer.text
    house.ledger.imported.setdefault(name, []).append(answer.json()["version"])
