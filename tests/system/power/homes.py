"""Homes in which recordings start."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from service.storage.database import Database
from tests.system.faults.harness import populate_home
from tests.system.power.checking import read_facts
from tests.system.power.recording import Recording
from tests.system.upgrades.test_homes import unpack_home


def migrated_facts(home: Path) -> dict[str, Any]:
    """Migrate a home; return the facts that it contains."""
    database = Database(home)
    with database.session() as session:
        found = read_facts(session)
    database.close()
    return found


def populated_home(recording: Recording) -> dict[str, Any]:
    """Create the home of a recording, with a learning model; return its facts."""
    populate_home(recording.home)
    return migrated_facts(recording.home)


def earlier_release_home(recording: Recording, folder: Path) -> dict[str, Any]:
    """Create the home of a recording from release 0.2.0; return its facts after migration."""
    shutil.move(unpack_home(folder), recording.home)
    return migrated_facts(Path(shutil.copytree(recording.home, folder / "migrated")))
