"""Services that share a model which learns, in this process or in processes of their own."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import lipcore
from service.storage.database import Database
from service.storage.files import Files
from tests.cluster.servers import Shared
from tests.service.data import eventually, service_of
from tests.service.learning.lessons import QUERIES, Pupil, publish
from tests.service.learning.pendulums import trained

Result = TypeVar("Result")
HARMLESS = {"contact_threshold": 100.0, "on_change": "learn", "auto_refresh": False}
"""How a model learns for which contacts are far off."""


def folder_store(shared: Shared) -> str:
    """A folder as the files that services share: lighter than S3, which other tests have."""
    folder = shared.folder / "files"
    folder.mkdir(exist_ok=True)
    return f"file://{folder}"


def made(shared: Shared, trained: Path, *models: str) -> None:
    """Publish models where no service runs yet, in a folder as the store."""
    settings = shared.settings("before", files_url=folder_store(shared))
    database = Database.of(settings)
    for model in models:
        publish(database, Files.of(settings), trained, model)
    database.close()


def train(folder: Path) -> Path:
    """A model of a double pendulum, saved below a folder."""
    lipcore.save(trained(), folder)
    return folder


@dataclass(frozen=True)
class Pair:
    """Clients of services that share what they know, and the folder of a trained model."""

    clients: Sequence[Any]
    trained: Path

    def enrol(self, model: str, **options: Any) -> tuple[Pupil, ...]:
        """A new model, as each service shows it; every one has answered for it."""
        service = service_of(self.clients[0])
        publish(service.database, service.files, self.trained, model)
        pupils = tuple(Pupil(client, model) for client in self.clients)
        pupils[0].put("learning", HARMLESS | options)
        for pupil in pupils:
            pupil.predict()
        return pupils


def both(*work: Callable[[], Result]) -> list[Result]:
    """Do things at the same time; return what came of each."""
    with ThreadPoolExecutor(len(work)) as threads:
        return [each.result() for each in [threads.submit(do) for do in work]]


def answers(pupils: Sequence[Pupil], revision: int) -> list[dict[str, Any]]:
    """What each service answers once it has learnt up to a revision, and knows what intervals are wide by now."""
    for pupil in pupils:
        pupil.settled(revision)
    eventually(lambda: len({str(pupil.predict(QUERIES)["scale"]) for pupil in pupils}) == 1)
    return [pupil.predict(QUERIES) for pupil in pupils]
