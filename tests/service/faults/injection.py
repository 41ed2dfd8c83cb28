"""Faults at named points of the service's code, without a line for them in it: see `injected/sitecustomize.py`."""

import json
import os
from collections.abc import Collection
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from tests.service.data import eventually

INJECTED = Path(__file__).parent / "injected"
COMMIT = "sqlalchemy.orm.session:Session.commit"
"""The end of every transaction; `within` says of which."""
PATIENCE = 300.0
"""Seconds after which what has to follow a fault has failed to: processes have to start, on a busy machine too."""
FSYNC, RENAME = "os:fsync", "os:rename"
"""A file is written, but may not be on the disk yet; it is, and gets its name."""


@dataclass(frozen=True)
class Fault:
    """What strikes where.

    target: function, `module:Class.function`; when: before it runs or after; within: function that has to be under way
    in the thread; victim: the process that comes there ("itself"), the service with it, as in a power cut ("service"),
    or that process is stopped for good, but not ended ("frozen"); skip: so many times it is let through.
    """

    target: str
    when: Literal["before", "after"] = "before"
    within: str | None = None
    victim: Literal["itself", "service", "frozen"] = "service"
    skip: int = 0


class Injector:
    """Strikes in the processes of a service that is started with `environment`.

    targets: all functions at which a fault may be asked for.
    """

    def __init__(self, folder: Path, targets: Collection[str]) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.file, self.targets = folder / "fault.json", sorted(set(targets))

    @property
    def environment(self) -> dict[str, str]:
        """Variables that the service has to be started with."""
        path = os.pathsep.join([str(INJECTED), *filter(None, [os.environ.get("PYTHONPATH")])])
        return {
            "PYTHONPATH": path,
            "LIPSERVE_FAULT_TARGETS": ",".join(self.targets),
            "LIPSERVE_FAULT_FILE": str(self.file),
        }

    def arm(self, fault: Fault, service: int) -> None:
        """Strike at the next occasion. service: id of its process, 0 where it is yet to be started."""
        assert fault.target in self.targets, fault.target
        self.disarm()
        self._beside("service").write_text(str(service))
        draft = self._beside("draft")
        draft.write_text(json.dumps(asdict(fault)))
        draft.rename(self.file)

    def disarm(self) -> None:
        """Strike no more, and forget what happened."""
        self.file.unlink(missing_ok=True)
        self._beside("happened").unlink(missing_ok=True)

    def happened(self) -> dict[str, Any] | None:
        """What has happened, once it has: id of the process, of its parent, and the fault."""
        try:
            return json.loads(self._beside("happened").read_text() or "null")
        except FileNotFoundError:
            return None

    def wait(self) -> dict[str, Any]:
        """Wait until the fault has happened; fail where it does not."""
        return eventually(self.happened, PATIENCE)

    def _beside(self, kind: str) -> Path:
        return self.file.with_name(f"{self.file.name}.{kind}")
