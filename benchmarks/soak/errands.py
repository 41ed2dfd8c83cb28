"""What is asked of a service beside its arm's loop, and how often: all routes, and the commands that a shift gives."""

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

KEPT, KEPT_VERSIONS = 12, 3
"""Data sets, and versions of a model, that are kept; older ones are deleted."""
PROFILE = "panda"
FIT = {"search_seconds": 5.0}
"""Of training jobs: the geometry is calibrated from the robot's URDF."""
ALTERNATE = "shift"
"""An alias that is moved to and fro."""
BACK = 3
"""Revisions that are taken back."""


@dataclass
class Desk:
    """Who runs errands: a client with a key. folder: for files; datasets: that are there, the oldest first."""

    day: Day
    http: httpx.Client
    home: Path
    folder: Path
    scene: Scene
    datasets: list[str]

    def ask(self, method: str, path: str, *expected: int, **request: Any) -> Any:
        """What is answered: JSON, or bytes; raise WrongAnswerError for another status than expected, 200 by default."""
        answer = self.http.request(method, path, **request)
        if answer.status_code not in (expected or (httpx.codes.OK,)):
            raise WrongAnswerError(f"{method} {path}: {answer.status_code} {answer.text[:240]}")
        told = answer.content and answer.headers.get("content-type") == "application/json"
        return answer.json() if told else answer.content

    def events(self, path: str, most: int) -> int:
        """Read server-sent events until so many, or the end; return how many came."""
        seen = 0
        with self.http.stream("GET", path) as answer:
            for line in answer.iter_lines():
                seen += line.startswith("event:")
                if seen >= most:
                    break
        if not seen:
            raise WrongAnswerError(f"GET {path}: no event")
        return seen

    def command(self, *arguments: str) -> str:
        """Run `lipserve` on the home; return what it prints."""
        env = {**os.environ, "LIPSERVE_HOME": str(self.home), "OMP_NUM_THREADS": "1"}
        command = [sys.executable, "-m", "service", *arguments]
        done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)  # noqa: S603 - our own
        if done.returncode:
            raise WrongAnswerError(f"lipserve {arguments[0]}: {done.stderr[-200:]}")
        return done.stdout

    def recording(self, turn: int) -> Samples:
        """Fifty seconds of the arm at 10 Hz, others each turn."""
        return replace(self.scene, seed=1 + turn % 50).history(50.0, 10.0)

    def at(self) -> dict[str, Any]:
        """A motion."""
        row = self.day.clock.now * 7 % len(self.day.samples)
        return {name: getattr(self.day.samples, name)[row].tolist() for name in ("q", "dq", "ddq")}


Errand = Callable[[Desk, int], Any]


def watch_over(desk: Desk, turn: int) -> None:
    """What monitoring asks for."""
    for path in ("/metrics", "/health", "/health/live", "/health/ready", "/v2/health/live", "/v2/health/ready"):
        desk.ask("GET", path)


def look_on(desk: Desk, turn: int) -> None:
    """What an open dashboard asks for."""
    desk.ask("GET", "/v1/overview")
    for path in ("learning", "quality", "observations?limit=10", "alarms?limit=5", "payload"):
        desk.ask("GET", f"/v1/models/{ARM}/{path}")


def look_around(desk: Desk, turn: int) -> None:
    """Everything that can be read."""
    paths = ["models", "audit?limit=20", "jobs", "datasets", "robots", "robots/profiles", f"robots/profiles/{PROFILE}"]
    for path in [*paths, f"models/{ARM}/aliases"]:
        desk.ask("GET", f"/v1/{path}")
    newest = {model: _versions(desk, model)[-1]["version"] for model in (ARM, LOOP)}
    desk.ask("GET", f"/v1/models/{ARM}/versions/{newest[ARM]}")
    batch = desk.ask("GET", f"/v1/models/{ARM}/observations?limit=1")["items"][0]
    desk.ask("GET", f"/v1/models/{ARM}/observations/{ARM}/{batch['sequence']}?rows=true")
    desk.ask("POST", f"/v1/models/{ARM}/predict", json={**desk.at(), "components": ["gravity", "friction"]})
    desk.ask("POST", "/v1/echo", json={**desk.at()})
    desk.ask("GET", "/v2")
    for path in (f"/v2/models/{LOOP}", f"/v2/models/{LOOP}/versions/{newest[LOOP]}"):
        desk.ask("GET", path)
        desk.ask("GET", f"{path}/ready")
        inputs = [{"name": name, "shape": [1, 7], "datatype": "FP64", "data": data} for name, data in desk.at().items()]
        desk.ask("POST", f"{path}/infer", json={"inputs": inputs})
    for path in ("/", "/docs", "/openapi.json", "/guide"):
        desk.ask("GET", path, 200, 307)


def follow(desk: Desk, turn: int) -> None:
    """Follow the arm live for a moment."""
    desk.events(f"/v1/models/{ARM}/live", 3)


def correct(desk: Desk, turn: int) -> None:
    """Learn what a contact has kept out, unlearn a batch, declare a payload and put it down, decide."""
    touched = turn * CONTACT_S // BATCH_S
    path = f"/v1/models/{ARM}/observations/{ARM}"
    desk.ask("POST", f"{path}/{touched}/replay", 200, 409, 422, json={"codes": ["contact"]})
    desk.ask("DELETE", f"{path}/{touched}", 200, 409)
    desk.ask("PUT", f"/v1/models/{ARM}/payload", json={"mass": 0.5, "com": [0.0, 0.0, 0.1], "stream_id": ARM})
    desk.ask("DELETE", f"/v1/models/{ARM}/payload?stream_id={ARM}")
    desk.ask("POST", f"/v1/models/{ARM}/learning/change", 200, 409, json={"decision": "ignore"})


def move(desk: Desk, turn: int) -> None:
    """Move an alias to and fro, and remove it."""
    versions = [each["version"] for each in desk.ask("GET", f"/v1/models/{ARM}")["versions"]]
    path = f"/v1/models/{ARM}/aliases/{ALTERNATE}"
    for version in (versions[0], versions[-1]):
        desk.ask("PUT", path, json={"version": version})
    desk.ask("POST", f"{path}/rollback", 200, 409, json={})
    desk.ask("DELETE", path, 204)


def judge(desk: Desk, turn: int) -> None:
    """Hold versions against a recording."""
    if not desk.datasets:
        return
    dataset, versions = desk.datasets[-1], [each["version"] for each in _versions(desk)]
    desk.ask("POST", f"/v1/models/{ARM}/evaluate", json={"dataset": dataset})
    desk.ask("POST", f"/v1/models/{ARM}/trace", json={"dataset": dataset, "points": 200, "components": ["gravity"]})
    if len(versions) > 1:
        chosen = [versions[0], versions[-1]]
        # 404: one was deleted meanwhile, as refreshes do
        desk.ask("POST", f"/v1/models/{ARM}/compare", 200, 404, json={"dataset": dataset, "versions": chosen})


def tidy(desk: Desk, turn: int) -> None:
    """Delete old versions."""
    for model in (ARM, LOOP):
        for each in _versions(desk, model)[:-KEPT_VERSIONS]:  # the oldest come first
            desk.ask("DELETE", f"/v1/models/{model}/versions/{each['version']}", 204, 404, 409)


def record(desk: Desk, turn: int) -> None:
    """Upload recordings in one file and in several, look at them, and delete older ones."""
    samples = desk.recording(turn)
    for content, kind in ((npz(samples), "application/x-npz"), (joined(samples), "application/zip")):
        query = {"name": f"day {turn} {kind}", "robot": PROFILE}
        made = desk.ask("POST", "/v1/datasets", 201, params=query, content=content, headers={"content-type": kind})
        desk.ask("GET", f"/v1/datasets/{made['id']}")
        desk.ask("GET", f"/v1/datasets/{made['id']}/preview?quantities=q,tau&points=100")
        desk.datasets.append(made["id"])
    while len(desk.datasets) > KEPT:
        desk.ask("DELETE", f"/v1/datasets/{desk.datasets.pop(0)}", 204)


def archive(desk: Desk, turn: int) -> None:
    """Export what was learnt, import it as another model, and delete that; the same of a URDF."""
    content = desk.ask("GET", f"/v1/models/{ARM}/export")
    kind = {"content-type": "application/x-tar"}
    desk.ask("POST", "/v1/models/import?name=copy&promotion=always", 201, content=content, headers=kind)
    desk.ask("DELETE", "/v1/models/copy", 204)
    desk.ask("GET", f"/v1/models/{ARM}/export?format=c")
    desk.ask("GET", f"/v1/models/{ARM}/urdf")
    urdf = profile_urdf(PROFILE)
    robot = desk.ask("POST", "/v1/robots", 201, content=urdf, headers={"content-type": "application/xml"})["id"]
    desk.ask("GET", f"/v1/robots/{robot}")
    desk.ask("DELETE", f"/v1/robots/{robot}", 204)


def set_learning(desk: Desk, turn: int) -> None:
    """Set how the arm learns, and go back to what was learnt a moment ago."""
    options = desk.ask("GET", f"/v1/models/{ARM}/learning")["options"]
    desk.ask("PUT", f"/v1/models/{ARM}/learning", json={**options, "forgetting_s": 3600.0 + turn})
    status = desk.ask("GET", f"/v1/models/{ARM}/learning")["status"]
    first, last = status["reachable"][-1]
    if first <= last - BACK:
        desk.ask("POST", f"/v1/models/{ARM}/rollback", 200, 409, json={"revision": last - BACK})


def train(desk: Desk, turn: int) -> None:
    """Train, from recordings and then from what was observed; cancel a job and repeat it."""
    if not desk.datasets:
        record(desk, turn)
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
        return  # by who corrects
    _succeeded(row)


def renew(desk: Desk, turn: int) -> None:
    """Refresh the model of the loop, where that is possible and not under way: from the first hour on, not only once
    it refreshes itself."""
    desk.ask("POST", f"/v1/models/{LOOP}/refresh", 202, 409, json={})


def keep(desk: Desk, turn: int) -> None:
    """Back the home up; make a key with a rate, ask by it beyond that, and revoke it."""
    file = desk.folder / f"backup-{turn}"
    desk.command("backup", str(file))
    file.unlink()
    made = json.loads(desk.command("keys", "create", "--name", "shift", "--scope", "read", "--rate", "1", "--json"))
    headers = {"authorization": f"Bearer {made['key']}"}
    for _ in range(30):
        desk.ask("GET", "/v1/models", 200, 401, 429, headers=headers)
    desk.command("keys", "revoke", made["id"])


ERRANDS: dict[int, tuple[Errand, ...]] = {
    10: (look_on,),
    15: (watch_over,),
    60: (look_around,),
    300: (follow, correct, move, judge, tidy),
    900: (record, archive, set_learning, renew),
    3600: (keep,),
}
"""By the arm seconds between two of a kind."""
SLOW: dict[int, tuple[Errand, ...]] = {3600: (train,)}
"""Those that the arm does not wait for."""


def run(desk: Desk, period: int, errands: tuple[Errand, ...], waited: bool = True) -> None:
    """Run errands of a period all day. waited: whether the arm waits for who runs them."""
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
    """Routes of the service's description that were never asked, by what it has counted."""
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
    """How a job ended, followed by its events."""
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
    """A recording as tables of text in a zip, one a quantity, without names of columns."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        parts = {"time": samples.t[:, None], "positions": samples.q, "velocities": samples.dq}
        for name, values in {**parts, "torques": samples.tau}.items():
            text = io.StringIO()
            np.savetxt(text, values, "%.9g")
            archive.writestr(f"{name}.txt", text.getvalue())
    return file.getvalue()
