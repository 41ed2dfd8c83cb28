"""Histories of real services under kills and standstills: nothing that anybody was told contradicts anything else."""

import os
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

from service.foundation.settings import Settings
from service.storage.database import Database
from service.storage.files import Files
from tests.cluster.pairs import HARMLESS, train
from tests.histories.actors import Book, Client, Killer, disturbed
from tests.histories.checker import contradictions
from tests.histories.rules import ABSENT, alias, journal
from tests.service.learning.lessons import publish
from tests.service.server import Server, free_port

MODEL = "arm"
CLIENTS = 4
SECONDS = float(os.environ.get("LIPSERVE_HISTORY_S", "6"))
"""How long clients ask: seconds in `make test`, minutes or an hour where the variable says so."""
SEED = int(os.environ.get("LIPSERVE_HISTORY_SEED", str(time.time_ns() % 10**6) if SECONDS > 60 else "50"))
"""Of what clients ask and who is killed when; another one each time in long runs."""


def prepared(settings: Settings, folder: Path) -> None:
    """A model of three versions that learns, where no service runs yet."""
    trained, database = train(folder), Database.of(settings)
    for _ in range(3):
        publish(database, Files.of(settings), trained, MODEL)
    database.close()


def check(book: Book) -> Counter[str]:
    """Count the operations of a history by kind, and those with an answer; fail on what contradicts itself."""
    counts = Counter(each.call[0] if isinstance(each.call[0], str) else "teach" for each in book.operations)
    counts["answered"] = sum(each.certain for each in book.operations)
    print(f"seed {SEED}: {dict(counts)}")  # noqa: T201 - of a history that fails, or with -s
    # a query by alias and the list of aliases tell of the same thing
    named = [replace(each, key=each.key.split()[1]) for each in book.operations if each.key != "journal"]
    assert contradictions(named, ABSENT, alias) == []
    assert contradictions(book.of("journal"), (*[-1] * CLIENTS, 0), journal) == []
    return counts


def test_one_service_that_is_killed_and_stopped(tmp_path: Path) -> None:
    home, port = tmp_path / "home", free_port()
    prepared(Settings(home=home), tmp_path / "trained")

    def again(_: int) -> Server:
        return Server(home, port=port)

    servers = [again(0)]
    servers[0].client.put(f"/v1/models/{MODEL}/learning", json=HARMLESS).raise_for_status()
    book = Book()
    clients = [Client(number, servers, MODEL, book, SEED) for number in range(CLIENTS)]
    killer = Killer(servers, again, SEED)
    try:
        assert disturbed(clients, killer, SECONDS, every_s=SECONDS / 3) == []
        assert check(book)["answered"] > 50
        assert sum(killer.done.values()) > 0
    finally:
        with servers[0]:
            pass
