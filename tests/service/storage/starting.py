"""Concurrent starts on one database."""

import threading
from collections.abc import Callable

from service.storage.database import Database
from service.storage.database.migrations import HEAD, revision


def check_starts_together(opens: Callable[[], Database], count: int = 4) -> None:
    """Open a database in several threads at the same moment; check that none fails and that its revision is current."""
    failures, opened = list[Exception](), list[Database]()
    barrier = threading.Barrier(count)

    def start() -> None:
        barrier.wait()
        try:
            opened.append(opens())
        except Exception as error:
            failures.append(error)

    threads = [threading.Thread(target=start) for _ in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures == []
    with opened[0].engine.connect() as connection:
        assert revision(connection) == HEAD
    for database in opened:
        database.close()
