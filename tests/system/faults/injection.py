"""Fault injection at named functions, without hooks in the service: see `injected/sitecustomize.py`."""

import json
import os
from collections.abc import Collection
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from tests.service.data import eventually

INJECTED = Path(__file__).parent / "injected"
COMMIT = "sqlalchemy.orm.session:Session.commit"
"""The end of every transaction; `within` selects one of them."""
TIMEOUT_S = 300.0
"""Timeout for recovery after a fault, including starts of processes on a busy machine."""
FSYNC, RENAME = "os:fsync", "os:rename"
"""Points at which a file is written but may not be on the disk, and at which it gets its final name."""


@dataclass(frozen=True)
class Fault:
    """A fault and its place.

    target: function, `module:Class.function`; when: before or after its call; within: function that must be on the
    stack of the thread; victim: the calling process ("itself"), that process and the service ("service"), or the
    calling process stopped forever instead of killed ("frozen"); skip: number of calls to ignore first.
    """

    target: str
    when: Literal["before", "after"] = "before"
    within: str | None = None
    victim: Literal["itself", "service", "frozen"] = "service"
    skip: int = 0


class Injector:
    """Injects faults into the processes of a service that is started with `environment`.

    targets: all functions at which faults may be injected.
    """

    def __init__(self, folder: Path, targets: Collection[str]) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.file, self.targets = folder / "fault.json", sorted(set(targets))

    @property
    def environment(self) -> dict[str, str]:
        """Environment variables for the service."""
        path = os.pathsep.join([str(INJECTED), *filter(None, [os.environ.get("PYTHONPATH")])])
        return {
            "PYTHONPATH": path,
            "LIPSERVE_FAULT_TARGETS": ",".join(self.targets),
            "LIPSERVE_FAULT_FILE": str(self.file),
        }

    def arm(self, fault: Fault, service: int) -> None:
        """Inject the fault at its next occasion. service: process id of the service, 0 before its start."""
        assert fault.target in self.targets, fault.target
        self.disarm()
        self._sibling("service").write_text(str(service))
        draft = self._sibling("draft")
        draft.write_text(json.dumps(asdict(fault)))
        draft.rename(self.file)

    def disarm(self) -> None:
        """Cancel the fault, and delete the report of one that has happened."""
        self.file.unlink(missing_ok=True)
        self._sibling("happened").unlink(missing_ok=True)

    def happened(self) -> dict[str, Any] | None:
        """Return the report of the fault, if it has happened: process id, parent's id and the fault."""
        try:
            return json.loads(self._sibling("happened").read_text() or "null")
        except FileNotFoundError:
            return None

    def wait(self) -> dict[str, Any]:
        """Wait for the report of the fault."""
        return eventually(self.happened, TIMEOUT_S)

    def _sibling(self, kind: str) -> Path:
        return self.file.with_name(f"{self.file.name}.{kind}")
