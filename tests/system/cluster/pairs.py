"""Services that share a learning model, in this process or in their own processes."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import lipcore
from service.storage.database import Database
from service.storage.files import Files
from tests.service.data import eventually, service_of
from tests.service.learning.learning_models import QUERIES, LearningModel, publish
from tests.service.learning.pendulums import trained_model
from tests.system.cluster.servers import Shared

Result = TypeVar("Result")
LEARN_EVERYTHING = {"contact_threshold": 100.0, "on_change": "learn", "auto_refresh": False}
"""Learning options under which no batch is rejected."""


def publish_models(shared: Shared, trained: Path, *models: str) -> None:
    """Publish models before any service runs, in a folder as the store."""
    settings = shared.settings("before", files_url=shared.folder_url)
    database = Database.of(settings)
    for model in models:
        publish(database, Files.of(settings), trained, model)
    database.close()


def train(folder: Path) -> Path:
    """Save a model of a double pendulum in a folder."""
    lipcore.save(trained_model(), folder)
    return folder


@dataclass(frozen=True)
class Pair:
    """Clients of services that share a database, and the folder of a trained model."""

    clients: Sequence[Any]
    trained: Path

    def enrol(self, model: str, **options: Any) -> tuple[LearningModel, ...]:
        """Publish a model; return it as each service shows it, after a first prediction by each."""
        service = service_of(self.clients[0])
        publish(service.database, service.files, self.trained, model)
        pupils = tuple(LearningModel(client, model) for client in self.clients)
        pupils[0].put("learning", LEARN_EVERYTHING | options)
        for pupil in pupils:
            pupil.predict()
        return pupils


def run_concurrently(*work: Callable[[], Result]) -> list[Result]:
    """Run functions at the same time; return their results."""
    with ThreadPoolExecutor(len(work)) as threads:
        return [each.result() for each in [threads.submit(do) for do in work]]


def predict_at_revision(pupils: Sequence[LearningModel], revision: int) -> list[dict[str, Any]]:
    """Return the predictions of each service once it has learnt up to a revision, with equal interval scales."""
    for pupil in pupils:
        pupil.wait_for_revision(revision)
    eventually(lambda: len({str(pupil.predict(QUERIES)["scale"]) for pupil in pupils}) == 1)
    return [pupil.predict(QUERIES) for pupil in pupils]
