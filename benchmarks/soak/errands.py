"""Periodic requests to a service besides the control loop: all routes, and some commands."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from benchmarks.online.scene import Scene
from benchmarks.soak.connections import WrongAnswerError, npz
from benchmarks.soak.day import ARM, BATCH_S, CONTACT_S, LOOP, Day
from lipcore.data.samples import Samples
from lipcore.robots.library import profile_urdf

MAX_DATASETS, MAX_VERSIONS = 12, 3
"""Data sets, and versions of a model, that are kept; older ones are deleted."""
PROFILE = "panda"
FIT = {"search_seconds": 5.0}
"""Options of training jobs; the geometry is calibrated from the robot's URDF."""
ALIAS = "shift"
"""An alias that moves between versions."""
ROLLBACK_REVISIONS = 3


@dataclass
class Desk:
    """A client with a key; folder: for files; datasets: stored data sets, oldest first."""

    day: Day
    http: httpx.Client
    home: Path
    folder: Path
    scene: Scene
    datasets: list[str]

    def ask(self, method: str, path: str, *expected: int, **request: Any) -> Any:
        """Return the answer, JSON or bytes; raise WrongAnswerError unless its status is expected (default: 200)."""
        answer = self.http.request(method, path, **request)
        if answer.status_code not in (expected or (httpx.codes.OK,)):
            raise WrongAnswerError(f"{method} {path}: {answer.status_code} {answer.text[:240]}")
        is_json = answer.content and answer.headers.get("content-type") == "application/json"
        return answer.json() if is_json else answer.content

    def events(self, path: str, limit: int) -> int:
        """Read at most `limit` server-sent events; return their number."""
        seen = 0
        with self.http.stream("GET", path) as answer:
            for line in answer.iter_lines():
                seen += line.startswith("event:")
                if seen >= limit:
                    break
        if not seen:
            raise WrongAnswerError(f"GET {path}: no event")
        return seen

    def command(self, *arguments: str) -> str:
        """Run `lipserve` on the home; return its output."""
        env = {**os.environ, "LIPSERVE_HOME": str(self.home), "OMP_NUM_THREADS": "1"}
        command = [sys.executable, "-m", "service", *arguments]
        done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)  # noqa: S603 - our own
        if done.returncode:
            raise WrongAnswerError(f"lipserve {arguments[0]}: {done.stderr[-200:]}")
        return done.stdout

    def recording(self, turn: int) -> Samples:
        """Return 50 s of the arm at 10 Hz, different in each turn."""
        return replace(self.scene, seed=1 + turn % 50).history(50.0, 10.0)

    def motion(self) -> dict[str, Any]:
        """Return q, dq and ddq at the present second."""
        row = self.day.clock.now * 7 % len(self.day.samples)
        return {name: getattr(self.day.samples, name)[row].tolist() for name in ("q", "dq", "ddq")}


Errand = Callable[[Desk, int], Any]


def scrape_health(desk: Desk, turn: int) -> None:
    """Send the requests of a monitoring system."""
    for path in ("/metrics", "/health", "/health/live", "/health/ready", "/v2/health/live", "/v2/health/ready"):
        desk.ask("GET", path)


def poll_dashboard(desk: Desk, turn: int) -> None:
    """Send the requests of an open dashboard."""
    desk.ask("GET", "/v1/overview")
    for path in ("learning", "quality", "observations?limit=10", "alarms?limit=5", "payload"):
        desk.ask("GET", f"/v1/models/{ARM}/{path}")


def read_resources(desk: Desk, turn: int) -> None:
    """Read every resource."""
    paths = ["models", "audit?limit=20", "jobs", "datasets", "robots", "robots/profiles", f"robots/profiles/{PROFILE}"]
    for path in [*paths, f"models/{ARM}/aliases"]:
        desk.ask("GET", f"/v1/{path}")
    newest = {model: _versions(desk, model)[-1]["version"] for model in (ARM, LOOP)}
    desk.ask("GET", f"/v1/models/{ARM}/versions/{newest[ARM]}")
    batch = desk.ask("GET", f"/v1/models/{ARM}/observations?limit=1")["items"][0]
    desk.ask("GET", f"/v1/models/{ARM}/observations/{ARM}/{batch['sequence']}?rows=true")
    desk.ask("POST", f"/v1/models/{ARM}/predict", json={**desk.motion(), "components": ["gravity", "friction"]})
    desk.ask("POST", "/v1/echo", json={**desk.motion()})
    desk.ask("GET", "/v2")
    for path in (f"/v2/models/{LOOP}", f"/v2/models/{LOOP}/versions/{newest[LOOP]}"):
        desk.ask("GET", path)
        desk.ask("GET", f"{path}/ready")
        inputs = [
            {"name": name, "shape": [1, 7], "datatype": "FP64", "data": data} for name, data in desk.motion().items()
        ]
        desk.ask("POST", f"{path}/infer", json={"inputs": inputs})
    for path in ("/", "/docs", "/openapi.json", "/guide"):
        desk.ask("GET", path, 200, 307)


def read_live_events(desk: Desk, turn: int) -> None:
    """Read some live events of the arm."""
    desk.events(f"/v1/models/{ARM}/live", 3)


def correct_learning(desk: Desk, turn: int) -> None:
    """Replay rejected rows, undo a batch, declare and remove a payload, decide about a change."""
    touched = turn * CONTACT_S // BATCH_S
    path = f"/v1/models/{ARM}/observations/{ARM}"
    desk.ask("POST", f"{path}/{touched}/replay", 200, 409, 422, json={"codes": ["contact"]})
    desk.ask("DELETE", f"{path}/{touched}", 200, 409)
    desk.ask("PUT", f"/v1/models/{ARM}/payload", json={"mass": 0.5, "com": [0.0, 0.0, 0.1], "stream_id": ARM})
    desk.ask("DELETE", f"/v1/models/{ARM}/payload?stream_id={ARM}")
    desk.ask("POST", f"/v1/models/{ARM}/learning/change", 200, 409, json={"decision": "ignore"})


def move_alias(desk: Desk, turn: int) -> None:
    """Move an alias between versions, roll it back and delete it."""
    versions = [each["version"] for each in desk.ask("GET", f"/v1/models/{ARM}")["versions"]]
    path = f"/v1/models/{ARM}/aliases/{ALIAS}"
    for version in (versions[0], versions[-1]):
        desk.ask("PUT", path, json={"version": version})
    desk.ask("POST", f"{path}/rollback", 200, 409, json={})
    desk.ask("DELETE", path, 204)


def evaluate(desk: Desk, turn: int) -> None:
    """Evaluate and compare versions on a recording."""
    if not desk.datasets:
        return
    dataset, versions = desk.datasets[-1], [each["version"] for each in _versions(desk)]
    desk.ask("POST", f"/v1/models/{ARM}/evaluate", json={"dataset": dataset})
    desk.ask("POST", f"/v1/models/{ARM}/trace", json={"dataset": dataset, "points": 200, "components": ["gravity"]})
    if len(versions) > 1:
        chosen = [versions[0], versions[-1]]
        # 404: a version may have been deleted meanwhile
        desk.ask("POST", f"/v1/models/{ARM}/compare", 200, 404, json={"dataset": dataset, "versions": chosen})


def delete_versions(desk: Desk, turn: int) -> None:
    """Delete old versions."""
    for model in (ARM, LOOP):
        for each in _versions(desk, model)[:-MAX_VERSIONS]:  # oldest first
            desk.ask("DELETE", f"/v1/models/{model}/versions/{each['version']}", 204, 404, 409)


def upload_recordings(desk: Desk, turn: int) -> None:
    """Upload recordings as one file and as several, read them, and delete older ones."""
    samples = desk.recording(turn)
    for content, kind in ((npz(samples), "application/x-npz"), (joined(samples), "application/zip")):
        query = {"name": f"day {turn} {kind}", "robot": PROFILE}
        made = desk.ask("POST", "/v1/datasets", 201, params=query, content=content, headers={"content-type": kind})
        desk.ask("GET", f"/v1/datasets/{made['id']}")
        desk.ask("GET", f"/v1/datasets/{made['id']}/preview?quantities=q,tau&points=100")
        desk.datasets.append(made["id"])
    while len(desk.datasets) > MAX_DATASETS:
        desk.ask("DELETE", f"/v1/datasets/{desk.datasets.pop(0)}", 204)


def exchange_archives(desk: Desk, turn: int) -> None:
    """Export a version in all formats, import it as another model and delete that; upload and delete a robot."""
    content = desk.ask("GET", f"/v1/models/{ARM}/export")
    kind = {"content-type": "application/x-tar"}
    desk.ask("POST", "/v1/models/import?name=copy&promotion=always", 201, content=content, headers=kind)
    desk.ask("DELETE", "/v1/models/copy", 204)
    for name in ("c", "urdf", "mjcf"):
        desk.ask("GET", f"/v1/models/{ARM}/export?format={name}")
    urdf = profile_urdf(PROFILE)
    robot = desk.ask("POST", "/v1/robots", 201, content=urdf, headers={"content-type": "application/xml"})["id"]
    desk.ask("GET", f"/v1/robots/{robot}")
    desk.ask("DELETE", f"/v1/robots/{robot}", 204)


def set_learning(desk: Desk, turn: int) -> None:
    """Change the learning options, and roll back to an earlier revision."""
    options = desk.ask("GET", f"/v1/models/{ARM}/learning")["options"]
    desk.ask("PUT", f"/v1/models/{ARM}/learning", json={**options, "forgetting_s": 3600.0 + turn})
    status = desk.ask("GET", f"/v1/models/{ARM}/learning")["status"]
    first, last = status["reachable"][-1]
    if first <= last - ROLLBACK_REVISIONS:
        desk.ask("POST", f"/v1/models/{ARM}/rollback", 200, 409, json={"revision": last - ROLLBACK_REVISIONS})


def train(desk: Desk, turn: int) -> None:
    """Train from recordings, cancel and retry a job, then retrain from observations."""
    if not desk.datasets:
        upload_recordings(desk, turn)
    request = {
        "model": ARM,
        "datasets": desk.datasets[-3::2],  # of each recording one of the two files
        "estimator": "rigid-body",
        "robot": PROFILE,
        "options": FIT,
    }
    desk.ask("POST", "/v1/jobs/check", 204, json=request)
    _done(desk, desk.ask("POST", "/v1/jobs", 202, json=request)["id"])
    job = desk.ask("POST", "/v1/jobs", 202, json=request)["id"]
    desk.ask("POST", f"/v1/jobs/{job}/cancel", 200, 202, 409)
    _ended(desk, job)
    _done(desk, desk.ask("POST", f"/v1/jobs/{job}/retry", 202)["id"])
    row = _ended(desk, desk.ask("POST", f"/v1/models/{ARM}/refresh", 202, json={})["id"])
    if row["state"] == "failed" and row["error"]["code"] == "observations_taken_back":
        return  # by `correct_learning`, which runs at the same time
    _succeeded(row)


def retrain(desk: Desk, turn: int) -> None:
    """Retrain the model of the loop if possible, from the first hour on."""
    desk.ask("POST", f"/v1/models/{LOOP}/refresh", 202, 409, json={})


def back_up(desk: Desk, turn: int) -> None:
    """Make a backup; create a key with a rate limit, exceed the limit, and revoke the key."""
    file = desk.folder / f"backup-{turn}"
    desk.command("backup", str(file))
    file.unlink()
    made = json.loads(desk.command("keys", "create", "--name", "shift", "--scope", "read", "--rate", "1", "--json"))
    headers = {"authorization": f"Bearer {made['key']}"}
    for _ in range(30):
        desk.ask("GET", "/v1/models", 200, 401, 429, headers=headers)
    desk.command("keys", "revoke", made["id"])


ERRANDS: dict[int, tuple[Errand, ...]] = {
    10: (poll_dashboard,),
    15: (scrape_health,),
    60: (read_resources,),
    300: (read_live_events, correct_learning, move_alias, evaluate, delete_versions),
    900: (upload_recordings, exchange_archives, set_learning, retrain),
    3600: (back_up,),
}
"""Errands by their period in arm seconds."""
SLOW: dict[int, tuple[Errand, ...]] = {3600: (train,)}
"""Errands that the arm does not wait for."""


def run(desk: Desk, period: int, errands: tuple[Errand, ...], waited: bool = True) -> None:
    """Run errands of a period all day; waited: whether the clock of the arm waits for them."""
    name = f"every {period} s: {errands[0].__name__}"
    for turn, at in enumerate(range(0, desk.day.clock.seconds, period)):
        if not desk.day.clock.follow(name, at + BATCH_S):
            break
        if not waited:
            desk.day.clock.leave(name)
        for errand in errands:
            desk.day.tally.attempt(errand.__name__.replace("_", " "), partial(errand, desk, turn))
    desk.day.clock.leave(name)


def unasked(desk: Desk) -> list[str]:
    """Return routes of the OpenAPI document that the service has not counted a request for."""
    text = desk.ask("GET", "/metrics").decode()
    counted = {
        (labels["method"], labels["route"])
        for line in text.splitlines()
        if line.startswith("lipserve_requests_total{")
        for labels in [dict(_labels(line))]
    }
    paths = desk.ask("GET", "/openapi.json")["paths"]
    return [
        f"{verb.upper()} {path}"
        for path, verbs in paths.items()
        for verb in verbs
        if (verb.upper(), path) not in counted
    ]


def _labels(line: str) -> list[tuple[str, str]]:
    inner = line[line.index("{") + 1 : line.rindex("}")]
    return [(name, value.strip('"')) for name, _, value in (part.partition("=") for part in inner.split('",'))]


def _versions(desk: Desk, model: str = ARM) -> list[Any]:
    listed: list[Any] = desk.ask("GET", f"/v1/models/{model}")["versions"]
    return listed


def _ended(desk: Desk, job: str) -> Any:
    """Follow the events of a job until it ends; return the job."""
    while True:
        desk.events(f"/v1/jobs/{job}/events", 10_000)
        row = desk.ask("GET", f"/v1/jobs/{job}")
        if row["state"] not in ("queued", "running"):
            return row


def _done(desk: Desk, job: str) -> None:
    _succeeded(_ended(desk, job))


def _succeeded(row: Any) -> None:
    if row["state"] != "succeeded":
        raise WrongAnswerError(f"job {row['id']} has {row['state']}: {row['error']}")


def joined(samples: Samples) -> bytes:
    """Return a recording as a zip of text tables, one for each quantity, without column names."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        parts = {"time": samples.t[:, None], "positions": samples.q, "velocities": samples.dq}
        for name, values in {**parts, "torques": samples.tau}.items():
            text = io.StringIO()
            np.savetxt(text, values, "%.9g")
            archive.writestr(f"{name}.txt", text.getvalue())
    return file.getvalue()
