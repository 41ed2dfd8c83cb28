"""A laboratory: robots, the service that learns from them, its clock, and the ledger of what it acknowledged."""

from __future__ import annotations

import re
import signal
import tarfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random
from typing import Any, Self

import httpx

from lipserve.states import ACTIVE
from service.cli.verify import verify_home
from service.foundation.settings import Settings
from service.training.ended import OUTCOMES
from tests import unpack
from tests.service.data import ended, eventually, stream, upload
from tests.service.server import Server
from tests.system.faults.ledger import list_items
from tests.system.histories.clock import Clock
from tests.year.ledger import DAY_S, Ledger
from tests.year.robots import ARMS, BATCHES, ESTIMATORS, VISCOUS, Robot
from tests.year.sizes import measure

OLD_HOME = Path(__file__).parents[1] / "system" / "upgrades" / "home-0.2.0.tar.xz"
OLD_MODELS = ("chain", "bodies")
RETENTION_S, RETENTION_BYTES = 7 * DAY_S, 2**21
"""Age and size up to which observations are kept: small arms reach the age first, large ones the size."""
AUDIT_RETENTION_S = 10 * DAY_S
QUOTA_BYTES = 2**33
"""Max bytes of the home: more than it ever has, but for the time of a full disk."""
TRAINING = {"hyperparameter_samples": 20, "posterior_samples": 60, "max_iterations": 4}
SETTINGS = {
    "TZ": "Europe/Berlin",  # has daylight saving; nothing stored may depend on it
    "LIPSERVE_OBSERVATION_RETENTION_S": f"{RETENTION_S:g}",
    "LIPSERVE_OBSERVATION_RETENTION_BYTES": str(RETENTION_BYTES),
    "LIPSERVE_AUDIT_RETENTION_S": f"{AUDIT_RETENTION_S:g}",
    "LIPSERVE_MAX_HOME_BYTES": str(QUOTA_BYTES),
    "LIPSERVE_MAX_SNAPSHOTS": "4",
    "LIPSERVE_MAX_LOADED_MODELS": "40",
    "LIPSERVE_PUBLISH_EVERY_S": "0.05",
    "LIPSERVE_PROMOTION": "always",
}


class _PatientServer(Server):
    patience = 1800.0


class Laboratory:
    """A service on a home of release 0.2.0, and robots that send their rows to it; a context manager.

    day: number of days that have passed. guests: number of models that were made and deleted. datasets: ids of the
    uploaded data sets of each model. jobs: states of all jobs ever listed. spent: seconds spent on each kind of
    happening.
    """

    def __init__(self, folder: Path, robots: int, seed: int) -> None:
        self.home, self.clock, self.ledger = folder / "home", Clock(folder / "clock"), Ledger()
        self.random, self.day, self.guests, self.datasets = Random(seed), 0, 0, dict[str, list[str]]()
        self.jobs, self.spent = dict[str, str](), Counter[str]()
        self.temporary = folder / "temporary"
        self.temporary.mkdir()
        with tarfile.open(OLD_HOME) as tar:
            unpack(tar, self.home)
        names = [*OLD_MODELS, *(f"arm-{number:02}" for number in range(len(OLD_MODELS), robots))][:robots]
        self.robots = [self._make_robot(number, name) for number, name in enumerate(names)]
        self.start()
        self.has_counted_jobs()
        for robot in self.robots:
            if robot.model not in OLD_MODELS:
                self.train(robot)
            options = {"on_change": "hold" if robot.model == names[-1] else "learn", "contact_threshold": 30.0}
            self.request("PUT", f"/v1/models/{robot.model}/learning", json=options)

    def _make_robot(self, number: int, model: str) -> Robot:
        random = Random(self.random.random())
        robot = Robot(model, ARMS[number % len(ARMS)], random, self.clock.now() - random.uniform(0.0, 1e6))
        robot.measures_acceleration = number % 3 != 2
        robot.friction = -VISCOUS if model in OLD_MODELS else 0.0  # their recordings were without friction
        return robot

    def start(self) -> None:
        """Start the service on its home."""
        environment = {**SETTINGS, **self.clock.environment, "TMPDIR": str(self.temporary)}
        self.server = _PatientServer(self.home, module="tests.year.serving", **environment)
        self.client = self.server.client
        self.client.event_hooks["response"].append(self.ledger.note_answer)

    def stop(self, kill: bool = False) -> None:
        """Check the counters of the service and stop it, with SIGKILL if `kill`."""
        self.check_counters()
        if kill:
            self.server.kill()
        else:
            assert self.server.terminate() in (0, -signal.SIGTERM)
        self.client.close()
        self.ledger.life.clear()

    def restart(self, kill: bool = False) -> None:
        """Stop the service and start it again."""
        self.stop(kill)
        self.start()

    def request(self, method: str, path: str, *refused: int, **options: Any) -> Any:
        """Return the body of an answer, or None if its status is one of `refused`; fail at any other error."""
        answer = self.client.request(method, path, **options)
        if answer.status_code in refused:
            return None
        assert answer.status_code < 300, (method, path, answer.text)
        return answer.json() if answer.content else {}

    def send(self, robot: Robot, body: dict[str, Any] | None = None) -> dict[str, Any]:
        """Send a batch of a robot, by default its next one; return its acknowledgement."""
        body = robot.batch(self.clock.now()) if body is None else body
        reply: dict[str, Any] = self.request("POST", f"/v1/models/{robot.model}/observations", json=body)
        self.ledger.note_batch(robot.model, body, reply, self.clock.now())
        return reply

    def train(self, robot: Robot) -> dict[str, Any]:
        """Upload a recording of a robot's arm, and train a version that serves; return the job."""
        samples = stream(robot.arm, 200, seed=self.random.randrange(10), viscous=max(VISCOUS + robot.friction, 0.0))
        dataset = upload(self.client, samples)["id"]
        self.datasets.setdefault(robot.model, []).append(dataset)
        request = {
            "model": robot.model,
            "datasets": [dataset],
            "estimator": ESTIMATORS.get(robot.arm, "rigid-body" if robot.model == "bodies" else "lip-chain"),
            "robot": robot.arm if robot.arm in ESTIMATORS else None,
            "options": TRAINING,
            "holdout": None,
        }
        done: dict[str, Any] = ended(self.client, self.request("POST", "/v1/jobs", json=request)["id"])
        assert done["state"] == "succeeded", done
        return done

    def pass_day(self, happenings: Sequence[Callable[[Laboratory], None]]) -> None:
        """Let a day pass. After each part of it, every robot sends a batch, and some of the `happenings` take place."""
        for part in range(BATCHES):
            self.clock.sleep(DAY_S / BATCHES)
            for robot in self.robots:
                reply = self.send(robot)
                if reply["held"]:
                    decision = {"decision": self.random.choice(("adapt", "ignore"))}
                    self.request("POST", f"/v1/models/{robot.model}/learning/change", 409, json=decision)
            for happening in happenings[part::BATCHES]:
                began = time.monotonic()
                try:
                    happening(self)
                except BaseException as error:
                    error.add_note(f"on day {self.day}, after {happening.__name__}")
                    raise
                self.spent[happening.__name__] += time.monotonic() - began
        self.day += 1

    def settle(self) -> None:
        """Wait until answers contain everything that is logged, and no job runs."""
        eventually(lambda: self.has_counted_jobs() and set(ACTIVE).isdisjoint(self.jobs.values()))
        for robot in self.robots:
            learning = f"/v1/models/{robot.model}/learning"
            eventually(lambda path=learning: self.request("GET", path)["status"]["lag_events"] == 0)
        eventually(self.is_ready)

    def has_counted_jobs(self) -> bool:
        """List the jobs; return whether /metrics counts all that ever ended, also deleted ones."""
        self.jobs |= {each["id"]: each["state"] for each in list_items(self.client, "/v1/jobs")}
        states = Counter(self.jobs.values())
        lines = [f'lipserve_jobs_finished_total{{outcome="{each}"}} {states[each]}.0' for each in OUTCOMES]
        return set(lines) <= set(self.metrics().splitlines())

    def is_ready(self) -> bool:
        """Return whether every part of the service works."""
        return self.client.get("/health/ready").status_code == httpx.codes.OK

    def metrics(self) -> str:
        """Return the text of /metrics."""
        answer = self.client.get("/metrics")
        assert answer.status_code == httpx.codes.OK
        return answer.text

    def measure(self) -> dict[str, float]:
        """Return the sizes of the service, and the numbers with which they may grow, see `tests.year.sizes`."""
        counts = {
            "acknowledged rows": self.ledger.rows,
            "deleted models": self.guests,
            "requests": self.ledger.requests,
        }
        return measure(self.home, self.temporary, self.server.process.pid, self.server.log, self.metrics()) | counts

    def check_counters(self) -> None:
        """Compare the counters of /metrics with the ledger."""
        self.ledger.check_counters(self.metrics())

    def check(self) -> None:
        """Check the home, the ledger and the counters, once everything is learnt."""
        self.settle()
        self.check_counters()
        assert verify_home(Settings(home=self.home)).damages == []
        self.ledger.check_home(self.home, self.clock.now(), RETENTION_S, RETENTION_BYTES)
        self.ledger.check_rows(self.home, self.random.sample(sorted(self.ledger.batches)[-100:], 20))
        records = re.split(r"^(?=\d{4}-\d\d-\d\dT)", self.server.log.read_text(), flags=re.MULTILINE)
        failed = [each for each in records if "Traceback" in each and "TakenBackError" not in each]
        assert failed == [], failed[0][:3000]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.server.__exit__(None, None, None)
