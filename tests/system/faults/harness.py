"""A service on its own home, with injected faults and a ledger of acknowledged writes."""

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
from tests.service.learning.pendulums import trained_model
from tests.service.server import Server, command, descendants
from tests.system.faults.injection import TIMEOUT_S, Fault, Injector
from tests.system.faults.ledger import ARM, Ledger

SETTINGS = {
    "PUBLISH_EVERY_S": "0.02",
    "SNAPSHOT_EVERY_S": "0.2",
    "MAX_SNAPSHOTS": "3",
    "MAX_PAGE": "100",
    "LEARNER_NICENESS": "0",
    "TRAINING_NICENESS": "0",
    "JOB_HEARTBEAT_S": "10",
}
"""Short intervals for revisions and snapshots, and normal priorities, because other tests run beside it."""


def populate_home(home: Path) -> None:
    """Publish two equal versions of a double pendulum in a new home; version 1 serves and learns."""
    database, files = Database(home), Files(home)
    for number, candidate in ((1, False), (2, True)):
        manifest = lipcore.save(trained_model(), files.versions / f"mv_arm{number}")
        with database.transaction() as session:
            registry.publish(session, ARM, f"mv_arm{number}", manifest, None, candidate=candidate)
            if candidate:
                registry.serve(session, ARM, 2)
                registry.serve(session, ARM, 1)
    options = LearningOptions(contact_threshold=100.0, on_change="learn", auto_refresh=False)
    with database.transaction() as session:
        session.add(LearningRow(model=ARM, options=options.model_dump(), held=None))
    database.close()


class _PatientServer(Server):
    patience = TIMEOUT_S


class FaultHarness:
    """A home, the service on it, and the ledger of acknowledged writes; a context manager.

    targets: functions at which faults may be injected; populated: whether the home has a learning model; settings: of
    the service, in capitals; has_own_disk: whether its disk can be filled.
    """

    def __init__(self, folder: Path, targets: set[str], populated: bool = True, **settings: str) -> None:
        self.home, self.ledger = folder / "home", Ledger()
        self.populated = populated
        if populated:
            populate_home(self.home)
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
        """The client of the current server process."""
        return self.server.client

    def next_number(self) -> int:
        """Return a new number."""
        self._numbers += 1
        return self._numbers

    def start(self) -> None:
        """Start the service and wait until it is ready."""
        self.server = _PatientServer(self.home, **self.settings, **self.injector.environment)

    def verify(self) -> None:
        """Check that the service has every acknowledged write, and no partial one."""
        self.ledger.verify(self.client, self.home, self.populated)

    def restart_if_dead(self) -> bool:
        """Restart the service if it was killed; return whether it was."""
        if self.server.process.poll() is None:
            return False
        orphans = self.orphans
        eventually(lambda: all(command(pid) == "" for pid in orphans), TIMEOUT_S)
        self.server.client.close()
        self.injector.disarm()
        self.start()
        return True

    def inject(self, fault: Fault, request: Callable[[FaultHarness], Any]) -> bool:
        """Inject a fault during a request; return whether the request was answered.

        The service runs afterwards: it is restarted if the fault has killed it.
        """
        self.orphans = descendants(self.server.process.pid)
        self.injector.arm(fault, self.server.process.pid)
        try:
            request(self)
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

    def inject_at_start(self, fault: Fault) -> None:
        """Kill the service, kill its next start by a fault, and start it again."""
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
