"""Makes the home of an earlier release that `test_homes` opens, and a file with that release's responses.

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
"""Versions in the order of their training."""
REVISIONS = {"chain": 5, "bodies": 4}
"""Final revision of each serving version."""
SENT_BATCHES, BATCHES, ROWS, RATE = 4, 8, 10, 100.0
"""Batches that are sent, batches that are recorded, rows per batch, rows per second."""


def recording(samples: int, seed: int) -> Any:
    """Simulate a recording of a double pendulum."""
    return simulate(load_robot("double-pendulum"), Simulation(n_samples=samples, speed=5.0), seed)


def observation_batch(number: int) -> dict[str, Any]:
    """Return the observation batch of a number."""
    rows = slice(number * ROWS, (number + 1) * ROWS)
    body = {name: getattr(recording(400, 12), name)[rows].tolist() for name in ("q", "dq", "ddq", "tau")}
    times = (np.arange(ROWS) + number * ROWS) / RATE
    return {"stream_id": "robot-1", "sequence": number, "t": times.tolist(), **body}


def check_success(answer: Any) -> Any:
    """Return the body of a response; raise if it is an error."""
    assert answer.status_code < 300, answer.text
    return answer.json() if answer.content else None


def train(api: TestClient) -> str:
    """Upload a recording and train all versions on it; return its id."""
    samples, file = recording(80, 1), io.BytesIO()
    arrays = {name: getattr(samples, name) for name in ("t", "q", "dq", "ddq", "tau")}
    np.savez(file, joint_names=np.array(samples.joint_names), **arrays)
    headers, named = {"content-type": "application/x-npz"}, {"name": f"recorded with {lipserve.__version__}"}
    dataset: str = check_success(api.post("/v1/datasets", content=file.getvalue(), headers=headers, params=named))["id"]
    for model, estimator in MODELS:
        request = {"model": model, "datasets": [dataset], "estimator": estimator, "options": QUICK}
        job = check_success(api.post("/v1/jobs", json={**request, "promotion": "always"}))
        while (seen := check_success(api.get(f"/v1/jobs/{job['id']}")))["state"] in ("queued", "running"):
            time.sleep(0.2)
        assert seen["state"] == "succeeded", seen
    return dataset


def send_batches(api: TestClient) -> None:
    """Send batches to both models, slowly enough for snapshots in between, and unlearn one batch of the first model."""
    for model in REVISIONS:
        options = {"contact_threshold": 100.0, "on_change": "learn", "auto_refresh": False}
        check_success(api.put(f"/v1/models/{model}/learning", json=options))
    for number in range(SENT_BATCHES):
        for model in REVISIONS:
            check_success(api.post(f"/v1/models/{model}/observations", json=observation_batch(number)))
        time.sleep(0.5)
    check_success(api.delete("/v1/models/chain/observations/robot-1/1"))


def main(home: Path, target: Path) -> None:
    """Make the home, and write the responses of the service on it."""
    settings = Settings(home=home, publish_every_s=0.05)
    queries = {name: getattr(recording(20, 11), name)[:6].tolist() for name in ("q", "dq", "ddq")}
    answers = {}
    with TestClient(create_app(settings), "http://localhost") as api:
        dataset = train(api)
        check_success(api.put("/v1/models/chain/aliases/production", json={"version": 1}))
        send_batches(api)
        check_success(api.delete("/v1/models/panda-sim"))  # half of the bytes, and not of the home's making
        for model, revision in REVISIONS.items():
            while (seen := check_success(api.post(f"/v1/models/{model}/predict", json=queries)))["revision"] < revision:
                time.sleep(0.1)
            answers[model] = seen
        named = api.post("/v1/models/chain/predict", json={**queries, "alias": "production"})
        answers["chain@production"] = check_success(named)
        models = {model: check_success(api.get(f"/v1/models/{model}")) for model in REVISIONS}
        time.sleep(1.0)
    command = [sys.executable, "-m", "service", "keys", "create", "--name=arm 1", "--scope=read,predict", "--json"]
    key = json.loads(subprocess.check_output(command, env={**os.environ, "LIPSERVE_HOME": str(home)}))
    with closing(sqlite3.connect(home / "lipserve.sqlite3", isolation_level=None)) as connection:
        for statement in ("VACUUM", "PRAGMA wal_checkpoint(TRUNCATE)"):
            connection.execute(statement)
    recorded = {"release": lipserve.__version__, "queries": queries, "answers": answers, "dataset": dataset}
    recorded |= {"models": models, "key": {"id": key["id"], "secret": key["key"]}}
    target.write_text(
        json.dumps({**recorded, "lessons": [observation_batch(number) for number in range(BATCHES)]}) + "\n"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
