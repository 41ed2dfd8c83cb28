"""A worker whose training processes do what a test wants instead of a fit: `python -m tests.cluster.light worker`.

What they do stands in the job's request, as {"do": …}: `finish` at once; `wait` until it says something else, and obey;
`deaf`, live and never look; `frozen`, as suspended by a debugger; `die`.
"""

import importlib
import json
import os
import signal
import time

import psycopg

from service.foundation.settings import Settings


def run(settings: Settings, job: str) -> None:
    """Do a job."""
    with psycopg.connect(settings.database_url, autocommit=True) as connection:
        if not _enter(connection, job, "queued", "running", "started", "attempts = attempts + 1, "):
            return
        while True:
            do, cancel = connection.execute(
                "SELECT request, cancel_requested FROM jobs WHERE id = %s", [job]
            ).fetchone()
            beat = "UPDATE jobs SET heartbeat_at = %s, progress = %s WHERE id = %s AND state = 'running'"
            connection.execute(beat, [repr(time.time()), json.dumps({"stage": "light", "process": os.getpid()}), job])
            match do["do"]:
                case "finish":
                    _enter(connection, job, "running", "succeeded", "done", "version = 1, ")
                    return
                case "wait" if cancel:
                    _enter(connection, job, "running", "cancelled", "obeyed")
                    return
                case "frozen":
                    os.kill(os.getpid(), signal.SIGSTOP)
                case "die":
                    os._exit(3)
            time.sleep(0.05)


def _enter(connection: psycopg.Connection, job: str, before: str, state: str, message: str, more: str = "") -> bool:
    entry = json.dumps([{"at": "", "state": state, "message": message}])
    change = f"UPDATE jobs SET {more} state = %s, history = history::jsonb || %s::jsonb WHERE id = %s AND state = %s"
    return connection.execute(change, [state, entry, job, before]).rowcount == 1


if __name__ == "__main__":
    from service.cli.main import main
    from service.training import worker

    worker.run = importlib.import_module("tests.cluster.light").run  # by the name that its processes know
    main()
