"""A home with a service that faults strike again and again, and that has to know all that it has acknowledged."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

import httpx
import pytest

import lipcore
from service.contract.observations import LearningOptions
from service.models import registry
from service.storage.database import Database, LearningRow
from service.storage.files import Files
from tests.service.data import DEADLINE, eventually
from tests.service.faults.injection import PATIENCE, Fault, Injector
from tests.service.faults.ledger import ARM, Ledger
from tests.service.learning.pendulums import trained
from tests.service.server import Server, children, command

SETTINGS = {
    "PUBLISH_EVERY_S": "0.02",
    "SNAPSHOT_EVERY_S": "0.2",
    "MAX_SNAPSHOTS": "3",
    "MAX_PAGE": "100",
    "LEARNER_NICENESS": "0",
    "TRAINING_NICENESS": "0",
    "JOB_HEARTBEAT_S": "10",
}
"""Of the service: revisions and snapshots follow each other fast, and its processes start fast beside other tests."""


def furnish(home: Path) -> None:
    """Put a model of a double pendulum with two equal versions into a new home; the first one serves and learns."""
    database, files = Database(home), Files(home)
    for number, candidate in ((1, False), (2, True)):
        manifest = lipcore.save(trained(), files.versions / f"mv_arm{number}")
        with database.transaction() as session:
            registry.publish(session, ARM, f"mv_arm{number}", manifest, None, candidate=candidate)
            if candidate:
                registry.serve(session, ARM, 2)
                registry.serve(session, ARM, 1)
    options = LearningOptions(contact_threshold=100.0, on_change="learn", auto_refresh=False)
    with database.transaction() as session:
        session.add(LearningRow(model=ARM, options=options.model_dump(), held=None))
    database.close()


class _Patient(Server):
    patience = PATIENCE


class House:
    """A home, the service that runs on it, and what that has acknowledged. Use it as a context manager.

    targets: functions at which faults may strike; furnished: whether there is a model that learns; settings: of the
    service, names in capitals; has_own_disk: whether its disk can be filled.
    """

    def __init__(self, folder: Path, targets: set[str], furnished: bool = True, **settings: str) -> None:
        self.home, self.ledger = folder / "home", Ledger()
        self.furnished = furnished
        if furnished:
            furnish(self.home)
        self.injector = Injector(folder / "faults", targets)
        self.settings = {f"LIPSERVE_{name}": value for name, value in (SETTINGS | settings).items()}
        self._numbers = 0
        self.has_own_disk = False

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.server.__exit__(None, None, None)

    @property
    def client(self) -> httpx.Client:
        """A client of the service as it runs now."""
        return self.server.client

    def number(self) -> int:
        """A number that was not given before."""
        self._numbers += 1
        return self._numbers

    def start(self) -> None:
        """Start the service and wait until it is ready."""
        self.server = _Patient(self.home, **self.settings, **self.injector.environment)

    def verify(self) -> None:
        """See that the service knows all that was acknowledged, and nothing half."""
        self.ledger.verify(self.client, self.home, self.furnished)

    def restart_if_dead(self) -> bool:
        """Start the service again where it was killed; return whether it was."""
        if self.server.process.poll() is None:
            return False
        orphans = self.orphans
        eventually(lambda: all(command(pid) == "" for pid in orphans), PATIENCE)
        self.server.client.close()
        self.injector.disarm()
        self.start()
        return True

    def strike(self, fault: Fault, ask: Callable[[House], Any]) -> bool:
        """Let a fault happen while something is asked for; return whether that was answered.

        Afterwards the service runs: it was started again where the fault has ended it.
        """
        self.orphans = children(self.server.process.pid)
        self.injector.arm(fault, self.server.process.pid)
        try:
            ask(self)
            answered = True
        except httpx.TransportError:
            answered = False
        happened = self.injector.wait()
        dies = fault.victim == "service" or happened["pid"] == self.server.process.pid
        if dies:
            assert self.server.process.wait(DEADLINE) == -signal.SIGKILL
            assert self.restart_if_dead()
        else:
            assert self.server.process.poll() is None
        self.injector.disarm()
        return answered

    def strike_start(self, fault: Fault) -> None:
        """Kill the service, let a fault end the next start, and start it for good."""
        self.server.kill()
        self.server.client.close()
        self.injector.arm(fault, 0)
        with pytest.raises(AssertionError):
            self.start()
        happened = self.injector.happened()
        assert happened is not None
        assert command(happened["pid"]) == ""
        self.injector.disarm()
        self.start()
