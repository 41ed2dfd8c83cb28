"""Homes of some life that stories begin with, and recordings of stories that several tests look at."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from service.storage.database import Database
from tests.service.faults.house import furnish
from tests.service.power.checking import facts
from tests.service.power.recording import Recording
from tests.service.upgrades.test_homes import unpacked


def known(home: Path) -> dict[str, Any]:
    """What a home holds; it is brought up to date."""
    database = Database(home)
    with database.session() as session:
        found = facts(session)
    database.close()
    return found


def furnished(recording: Recording) -> dict[str, Any]:
    """Give a recording a home with a model that learns; return what it holds."""
    furnish(recording.home)
    return known(recording.home)


def earlier(recording: Recording, folder: Path) -> dict[str, Any]:
    """Give a recording a home of release 0.2.0; return what it holds once it is brought up to date."""
    shutil.move(unpacked(folder), recording.home)
    return known(Path(shutil.copytree(recording.home, folder / "migrated")))
