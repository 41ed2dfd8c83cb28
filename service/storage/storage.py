"""What a service keeps things in: one database, one store of files, one disk that has to have room."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Request

from service.foundation.settings import Settings
from service.storage.database import Database
from service.storage.disk import Disk
from service.storage.files import Files


@dataclass(frozen=True)
class Storage:
    """The storage of a running service, and the limits of what is put there."""

    settings: Settings
    database: Database
    files: Files
    disk: Disk

    @classmethod
    def open(cls, settings: Settings) -> Storage:
        """Open, or make, what the settings name."""
        return cls(settings, Database.of(settings, settings.database_timeout_s), Files.of(settings), Disk(settings))


async def _storage(request: Request) -> Storage:
    found: Storage = request.app.state.storage
    return found


StorageDep = Annotated[Storage, Depends(_storage)]
