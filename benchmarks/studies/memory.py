"""Memory of a service that many versions and requests pass through: what it keeps of them.

    python benchmarks/studies/memory.py [ROUNDS]

A round uploads a recording, takes in three versions, and asks from eight clients at a time: single queries, batches
with covariances and components, evaluations, traces, previews, exports, comparisons. Then it deletes the recording. The
service runs on this machine with settings as they are, MALLOC_… of the environment too. Linux only.
"""

import io
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import httpx
import numpy as np

from benchmarks.processes import resident
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Stream, simulate

PORT, MODEL, CLIENTS, VERSIONS = 18_433, "panda-sim", 8, 3
TAR, NPZ = {"content-type": "application/x-tar"}, {"content-type": "application/x-npz"}


@contextmanager
def service(home: Path) -> Iterator[tuple[int, httpx.Client]]:
    """The process id of a service that is ready, and a client of it; it is killed in the end."""
    environment = {**os.environ, "LIPSERVE_HOME": str(home / "home")}
    with (home / "log").open("ab") as log, httpx.Client(base_url=f"http://127.0.0.1:{PORT}", timeout=120) as client:
        command = [sys.executable, "-m", "service", "serve", "--port", str(PORT)]
        process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)  # noqa: S603
        try:
            while not ready(client):
                time.sleep(0.1)
            yield process.pid, client
        finally:
            process.kill()
            process.wait()


def ready(client: httpx.Client) -> bool:
    """Whether the service answers."""
    try:
        return client.get("/health/ready").status_code == httpx.codes.OK
    except httpx.TransportError:
        return False


def recording(seed: int) -> bytes:
    """Some seconds of the Panda, as a file."""
    samples = simulate(load_robot("panda"), Stream(n_samples=2000), seed)
    file = io.BytesIO()
    columns = {name: getattr(samples, name) for name in ("t", "q", "dq", "ddq", "tau")}
    np.savez(file, joint_names=np.array(samples.joint_names), **columns)
    return file.getvalue()


def ask(client: httpx.Client, method: str, path: str, **more: object) -> httpx.Response:
    """One request that has to be answered."""
    answer = client.request(method, path, **more)  # type: ignore[arg-type]
    if not answer.is_success:
        raise RuntimeError(f"{method} {path}: {answer.text[:300]}")
    return answer


def round_of(client: httpx.Client, archive: bytes, data: bytes, number: int) -> int:
    """Upload, take in, ask, delete; return how many requests that were."""
    rng = np.random.default_rng(number)
    motion = {name: rng.uniform(-0.5, 0.5, (500, 7)).tolist() for name in ("q", "dq", "ddq")}
    few = {name: rows[:50] for name, rows in motion.items()}
    one = {name: rows[0] for name, rows in motion.items()}
    dataset = ask(client, "POST", "/v1/datasets", content=data, headers=NPZ).json()["id"]
    calls = []
    for _ in range(VERSIONS):
        parameters = {"name": f"passing-{number % 5}"}
        version = ask(client, "POST", "/v1/models/import", content=archive, headers=TAR, params=parameters).json()
        path, which = f"/v1/models/{version['model']}", {"version": version["version"]}
        calls += [("POST", f"{path}/predict", {"json": {**one, **which}})] * 20
        calls += [("POST", f"{path}/predict", {"json": {**motion, **which, "covariance": True}})] * 3
        calls += [("POST", f"{path}/predict", {"json": {**few, **which, "components": ["gravity", "friction"]}})]
        calls += [("POST", f"{path}/{each}", {"json": {"dataset": dataset, **which}}) for each in ("evaluate", "trace")]
        calls += [("GET", f"{path}/export", {"params": which}), ("GET", path, {}), ("GET", "/metrics", {})]
    calls += [("GET", f"/v1/datasets/{dataset}/preview", {}), ("GET", f"/v1/datasets/{dataset}", {})]
    with ThreadPoolExecutor(CLIENTS) as pool:
        list(pool.map(lambda call: ask(client, call[0], call[1], **call[2]), calls))
    ask(client, "DELETE", f"/v1/datasets/{dataset}")
    return len(calls) + VERSIONS + 2


def main() -> None:
    """Print resident memory along the rounds."""
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 60
    recordings = [recording(seed) for seed in range(3)]
    with tempfile.TemporaryDirectory() as folder, service(Path(folder)) as (pid, client):
        archive = ask(client, "GET", f"/v1/models/{MODEL}/export").content
        requests, began = 0, resident(pid)
        print("rounds  versions  requests  resident MB", flush=True)
        for number in range(rounds):
            requests += round_of(client, archive, recordings[number % 3], number)
            if number % max(rounds // 10, 1) == 0 or number == rounds - 1:
                print(f"{number + 1:6d}  {(number + 1) * VERSIONS:8d}  {requests:8d}  {resident(pid):8.0f}", flush=True)
        print(f"at the start {began:.0f} MB, at the end {resident(pid):.0f} MB")


if __name__ == "__main__":
    main()
