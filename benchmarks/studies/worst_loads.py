"""The worst that clients of a service do beside a control loop, for `control_loop_under_load.py`.

A load is a function of the service's port and an event that ends it. It runs in a process of its own.
"""

from __future__ import annotations

import http.client
import io
import json
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np

import lipserve
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, simulate
from lipserve import Client
from service.api.dashboard.routes import STATIC

MODEL, ARM, DATA = "panda-sim", "arm", "recording"
"""The model of the control loop; the model that is trained and learns; its data set."""
MiB = 1024 * 1024
LARGE_ROWS, ROWS, BATCH = 1_000_000, 1000, 1000
QUICK = {"hyperparameter_samples": 30, "posterior_samples": 60, "max_iterations": 4}
JSON, CSV = {"content-type": "application/json"}, {"content-type": "text/csv"}
TIMEOUT_S = 60.0
FAILURES = (OSError, http.client.HTTPException, lipserve.ApiError, lipserve.ServiceUnreachableError)
"""Errors of a service that is busy."""


def prepare(client: Client) -> None:
    """Upload a recording."""
    samples = simulate(load_robot("panda"), Simulation(ROWS, 100.0, speed=3.0, noise=0.05), 0)
    columns = {"t": samples.t} | {name: getattr(samples, name) for name in ("q", "dq", "ddq", "tau")}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{DATA}.npz"
        np.savez(path, **columns)
        client.upload(path, DATA)


def body_of(size: int) -> bytes:
    """Return a JSON body of numbers of this size."""
    return b'{"q":[' + b"0.123456," * (size // 9 - 2) + b"0]}"


def ask(port: int, method: str, path: str, body: bytes = b"", headers: dict[str, str] | None = None) -> int:
    """Send a request on a connection of its own; return the status, 0 if the service closes it."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=TIMEOUT_S)
    try:
        connection.request(method, path, body, headers or {})
        answer = connection.getresponse()
        answer.read()
        return answer.status
    except (OSError, http.client.HTTPException):
        return 0
    finally:
        connection.close()


def send_bodies(port: int, ending: Event) -> None:
    """Send bodies at the limit of each route, most of which are refused."""
    large, most = body_of(8 * MiB), body_of(8 * MiB + 1000)
    small = body_of(256 * 1024 - 100)
    sent = [
        (f"/v1/models/{MODEL}/predict", large, JSON),
        (f"/v1/models/{MODEL}/predict", most, JSON),
        (f"/v1/models/{ARM}/observations", large, JSON),
        (f"/v2/models/{MODEL}/infer", large, JSON),
        ("/v1/echo", large, JSON),
        ("/v1/jobs", small, JSON),
        ("/v1/robots", small, {"content-type": "application/xml"}),
        ("/v1/models/import?name=x", large, {"content-type": "application/x-tar"}),
        ("/v1/datasets?name=bad", b"t,q1,tau1\n" + b"1,nan,2\n" * MiB, CSV),
    ]
    while not ending.is_set():
        for path, body, headers in sent:
            ask(port, "POST", path, body, headers)
            if ending.is_set():
                break


def upload_large(port: int, ending: Event) -> None:
    """Upload a recording of a million rows, and delete it."""
    rows = np.random.default_rng(0).uniform(-1.0, 1.0, (LARGE_ROWS, 2))
    file = io.BytesIO()
    np.savez(file, t=np.arange(LARGE_ROWS) / 1000.0, q=rows, dq=rows, ddq=rows, tau=rows)
    with Client(f"http://127.0.0.1:{port}", timeout=600.0) as client, tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "large.npz"
        path.write_bytes(file.getvalue())
        while not ending.is_set():
            with suppress(*FAILURES):
                client.delete_dataset(client.upload(path, "large").id)


def train(port: int, ending: Event) -> None:
    """Train versions, promote them and move an alias back and forth."""
    with Client(f"http://127.0.0.1:{port}", timeout=TIMEOUT_S) as client:
        while not ending.is_set():
            with suppress(*FAILURES):
                client.wait(client.train(ARM, [DATA], "lip-chain", options=QUICK, promotion="always"))
                for version in (1, "serving", 1):
                    client.set_alias(ARM, "tested", version, override=True)
                client.rollback(ARM, version=1)


def refresh(port: int, ending: Event) -> None:
    """Send observations, and train again with them."""
    samples = simulate(load_robot("panda"), Simulation(ROWS, 100.0, speed=3.0, noise=0.05), 1)
    with Client(f"http://127.0.0.1:{port}", timeout=TIMEOUT_S) as client:
        sequence = 0
        while not ending.is_set():
            part = slice(sequence * 10 % (ROWS - 10), sequence * 10 % (ROWS - 10) + 10)
            q, dq, ddq, tau = (getattr(samples, name)[part] for name in ("q", "dq", "ddq", "tau"))
            t = 0.01 * np.arange(10 * sequence, 10 * sequence + 10)
            with suppress(*FAILURES):
                client.observe(ARM, "robot-1", sequence, q, dq, tau, ddq, t)
                sequence += 1
                if sequence % 100 == 0:
                    client.wait(client.refresh(ARM))
            ending.wait(0.05)


def predict_batches(port: int, ending: Event) -> None:
    """Four clients that ask for 1000 motions with covariance."""
    motions = np.random.default_rng(0).uniform(-1.0, 1.0, (3, BATCH, 7))
    asked = dict(zip(("q", "dq", "ddq"), motions.tolist(), strict=True)) | {"covariance": True}
    body = json.dumps(asked).encode()
    _at_once(4, ending, lambda: ask(port, "POST", f"/v1/models/{MODEL}/predict", body, JSON))


def evaluate(port: int, ending: Event) -> None:
    """Evaluate, trace and compare versions on a recording."""
    bodies = {
        "evaluate": {"dataset": DATA},
        "trace": {"dataset": DATA},
        "compare": {"dataset": DATA, "first": 1, "second": 1},
    }
    while not ending.is_set():
        for path, body in bodies.items():
            ask(port, "POST", f"/v1/models/{ARM}/{path}", json.dumps(body).encode(), JSON)


def watch_dashboards(port: int, ending: Event) -> None:
    """Eight dashboards: live feed, all polls, and all files of the page now and then."""
    files = [f"/dashboard/{path.relative_to(STATIC)}" for path in STATIC.rglob("*") if path.suffix in (".js", ".css")]
    polled = [
        "/v1/overview",
        "/v1/models",
        f"/v1/models/{ARM}",
        "/v1/datasets",
        "/v1/jobs",
        "/health/ready",
        "/metrics",
    ]
    polled += [f"/v1/models/{ARM}/{name}" for name in ("learning", "quality", "alarms")]

    def watch() -> None:
        live = http.client.HTTPConnection("127.0.0.1", port, timeout=TIMEOUT_S)
        live.request("GET", f"/v1/models/{ARM}/live")
        for _ in range(4):
            for path in polled:
                ask(port, "GET", path)
            if ending.wait(0.25):
                break
        for path in files:
            ask(port, "GET", path)
        live.close()

    _at_once(8, ending, watch)


LOADS: dict[str, Callable[[int, Event], None]] = {
    "bodies": send_bodies,
    "upload": upload_large,
    "training": train,
    "refresh": refresh,
    "batches": predict_batches,
    "evaluation": evaluate,
    "dashboards": watch_dashboards,
}


def _at_once(count: int, ending: Event, act: Callable[[], object]) -> None:
    """Repeat an act in several threads."""

    def repeat() -> None:
        while not ending.is_set():
            with suppress(*FAILURES):
                act()

    threads = [threading.Thread(target=repeat, daemon=True) for _ in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
