"""Makes the home of an earlier release that `test_homes` opens, and a file with what that release answered on it.

Run it with that release on the path, OLD being its checkout, and pack what a backup would hold:

    PYTHONPATH=OLD:OLD/clients/python python make_home.py home home-0.2.0.json
    tar -C home -cJf home-0.2.0.tar.xz lipserve.sqlite3 datasets versions $(cd home && ls learning/*.safetensors)

It uses nothing of this release but routes and commands, which are the same.
"""

import io
import json
import os
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from fastapi.testclient import TestClient

import lipserve
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, simulate
from service.app import create_app
from service.foundation.settings import Settings

QUICK = {"hyperparameter_samples": 20, "posterior_samples": 60, "max_iterations": 4}
MODELS = (("chain", "lip-chain"), ("chain", "lip-chain"), ("bodies", "rigid-body"))
"""Versions in the order that they are trained in."""
REVISIONS = {"chain": 5, "bodies": 4}
"""Of the version that serves, once it has learnt what it is taught."""
TAUGHT, LESSONS, ROWS, RATE = 4, 8, 10, 100.0
"""Lessons that it is taught, and that there are; rows of one; rows a second."""


def recording(samples: int, seed: int) -> Any:
    """A simulated recording of a double pendulum."""
    return simulate(load_robot("double-pendulum"), Simulation(n_samples=samples, speed=5.0), seed)


def lesson(number: int) -> dict[str, Any]:
    """The batch of a number."""
    rows = slice(number * ROWS, (number + 1) * ROWS)
    body = {name: getattr(recording(400, 12), name)[rows].tolist() for name in ("q", "dq", "ddq", "tau")}
    times = (np.arange(ROWS) + number * ROWS) / RATE
    return {"stream_id": "robot-1", "sequence": number, "t": times.tolist(), **body}


def asked(answer: Any) -> Any:
    """The body of an answer that refuses nothing."""
    assert answer.status_code < 300, answer.text
    return answer.json() if answer.content else None


def train(api: TestClient) -> str:
    """Upload a recording and train all versions on it; return its id."""
    samples, file = recording(80, 1), io.BytesIO()
    arrays = {name: getattr(samples, name) for name in ("t", "q", "dq", "ddq", "tau")}
    np.savez(file, joint_names=np.array(samples.joint_names), **arrays)
    headers, named = {"content-type": "application/x-npz"}, {"name": f"recorded with {lipserve.__version__}"}
    dataset: str = asked(api.post("/v1/datasets", content=file.getvalue(), headers=headers, params=named))["id"]
    for model, estimator in MODELS:
        request = {"model": model, "datasets": [dataset], "estimator": estimator, "options": QUICK}
        job = asked(api.post("/v1/jobs", json={**request, "promotion": "always"}))
        while (seen := asked(api.get(f"/v1/jobs/{job['id']}")))["state"] in ("queued", "running"):
            time.sleep(0.2)
        assert seen["state"] == "succeeded", seen
    return dataset


def teach(api: TestClient) -> None:
    """Teach both models, slowly enough for snapshots in between, and take one lesson back from the first."""
    for model in REVISIONS:
        options = {"contact_threshold": 100.0, "on_change": "learn", "auto_refresh": False}
        asked(api.put(f"/v1/models/{model}/learning", json=options))
    for number in range(TAUGHT):
        for model in REVISIONS:
            asked(api.post(f"/v1/models/{model}/observations", json=lesson(number)))
        time.sleep(0.5)
    asked(api.delete("/v1/models/chain/observations/robot-1/1"))


def main(home: Path, target: Path) -> None:
    """Make the home and write what is answered on it."""
    settings = Settings(home=home, publish_every_s=0.05)
    queries = {name: getattr(recording(20, 11), name)[:6].tolist() for name in ("q", "dq", "ddq")}
    answers = {}
    with TestClient(create_app(settings), "http://localhost") as api:
        dataset = train(api)
        asked(api.put("/v1/models/chain/aliases/production", json={"version": 1}))
        teach(api)
        asked(api.delete("/v1/models/panda-sim"))  # half of the bytes, and not of the home's making
        for model, revision in REVISIONS.items():
            while (seen := asked(api.post(f"/v1/models/{model}/predict", json=queries)))["revision"] < revision:
                time.sleep(0.1)
            answers[model] = seen
        named = api.post("/v1/models/chain/predict", json={**queries, "alias": "production"})
        answers["chain@production"] = asked(named)
        models = {model: asked(api.get(f"/v1/models/{model}")) for model in REVISIONS}
        time.sleep(1.0)
    command = [sys.executable, "-m", "service", "keys", "create", "--name=arm 1", "--scope=read,predict", "--json"]
    key = json.loads(subprocess.check_output(command, env={**os.environ, "LIPSERVE_HOME": str(home)}))
    with closing(sqlite3.connect(home / "lipserve.sqlite3", isolation_level=None)) as connection:
        for statement in ("VACUUM", "PRAGMA wal_checkpoint(TRUNCATE)"):
            connection.execute(statement)
    told = {"release": lipserve.__version__, "queries": queries, "answers": answers, "dataset": dataset}
    told |= {"models": models, "key": {"id": key["id"], "secret": key["key"]}}
    target.write_text(json.dumps({**told, "lessons": [lesson(number) for number in range(LESSONS)]}) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
