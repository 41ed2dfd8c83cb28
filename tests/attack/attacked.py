"""A service under attack, and the checks that an attack has left it sound.

LIPSERVE_ATTACK_SEED: seed of every attack; by default a new one for each run, which the summary prints.
"""

import json
import os
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from random import Random
from typing import Any, Self

import httpx

from service.cli.verify import verify_home
from service.foundation.settings import Settings
from tests.service.data import DEADLINE, eventually, post
from tests.service.server import Server, children
from tests.system.faults.harness import SETTINGS, populate_home

SEED = int(os.environ.get("LIPSERVE_ATTACK_SEED", str(time.time_ns() % 10**6)))
MiB = 1024 * 1024
MAX_GROWTH = 300 * MiB
"""Memory that a service may use more after an attack than before, with its processes: 120 MiB are
those of learning, which may start meanwhile."""
UNAVAILABLE = {"not_ready", "revision_not_reached", "storage_unavailable"}
"""The documented codes of answers with status 503."""
REFERENCE = {"q": [0.1] * 7, "dq": [0.2] * 7, "ddq": [0.3] * 7, "version": 1}
"""A query of the shipped model, which learns nothing: its answer never changes."""


def attack_random(name: str) -> Random:
    """Return the random numbers of an attack."""
    return Random(f"{SEED} {name}")


class AttackedService:
    """A service on a new home with the shipped model and the learning model `arm`; a context manager.

    statuses: number of answers by status; checked: length of the part of the log that was checked.
    """

    def __init__(self, folder: Path, populated: bool = True, **settings: str) -> None:
        self.home, self.statuses, self.checked = folder / "home", Counter[int](), 0
        self.settings = {f"LIPSERVE_{name}": value for name, value in (SETTINGS | settings).items()}
        if populated:
            populate_home(self.home)
        self.start()
        self.reference = self.predict_reference()
        assert post(self.client, b"", "text/csv").status_code == 422  # starts a process for readers
        self.memory = memory_bytes(self.server.process.pid)

    def start(self) -> None:
        """Start the service on its home."""
        self.server = Server(self.home, **self.settings)
        self.client, self.port = self.server.client, self.server.port
        self.client.event_hooks["response"].append(self.check_answer)

    def restart(self) -> None:
        """Kill the service with SIGKILL and start it again."""
        self.server.kill()
        self.server.client.close()
        self.start()

    def check_answer(self, answer: httpx.Response) -> None:
        """Count an answer; fail if it is an undocumented error of the service."""
        self.statuses[answer.status_code] += 1
        if answer.status_code >= 500:
            answer.read()
            assert is_documented(answer.status_code, answer.content), (answer.request.url, answer.text)

    def predict_reference(self) -> bytes:
        """Return the answer to REFERENCE."""
        answer = self.client.post("/v1/models/panda-sim/predict", json=REFERENCE)
        assert answer.status_code == httpx.codes.OK, answer.text
        return answer.content

    def check_sound(self, max_growth: int = MAX_GROWTH) -> None:
        """Check the answers, the log, the memory and the home."""
        eventually(lambda: self.client.get("/health/ready").status_code == httpx.codes.OK)
        assert self.predict_reference() == self.reference
        log = self.server.log.read_text()
        new, self.checked = log[self.checked :], len(log)
        assert "Traceback" not in new, new[new.index("Traceback") :]
        with suppress(AssertionError):  # readers of uploads may still be ending
            eventually(lambda: self.memory_growth() < max_growth, 5.0)
        assert self.memory_growth() < max_growth
        assert verify_home(Settings(home=self.home)).damages == []

    def memory_growth(self) -> int:
        """Return how much more memory the service and its processes use than after the start, bytes."""
        return memory_bytes(self.server.process.pid) - self.memory

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.server.__exit__(None, None, None)


def is_documented(status: int, content: bytes) -> bool:
    """Return whether an answer is below 500, or a documented 503."""
    if status < 500:
        return True
    try:
        return status == 503 and json.loads(content)["error"]["code"] in UNAVAILABLE
    except (ValueError, KeyError, TypeError):
        return False


def memory_bytes(pid: int) -> int:
    """Return the memory of a process and its descendants, shared pages in equal parts."""
    total = sum(map(memory_bytes, children(pid)))
    with suppress(OSError):  # it has ended
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                total += int(line.split()[1]) * 1024
    return total


def peak_bytes(pid: int) -> int:
    """Return the largest memory that a process has had so far."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM:"))


def query(answer: Any) -> dict[str, Any]:
    """Return the JSON of an answer; fail for numbers that JSON lacks."""
    return json.loads(answer.content, parse_constant=_refuse_constant)


def _refuse_constant(name: str) -> None:
    raise AssertionError(f"the answer contains {name}")


__all__ = ["DEADLINE", "SEED", "AttackedService", "MiB", "attack_random", "memory_bytes", "peak_bytes"]
