"""A worker whose training processes do what a test sets: `python -m tests.system.cluster.light worker`.

The job's request contains the action, as {"do": …}: `finish` at once; `wait`, until the action changes or the job is
cancelled; `deaf`, run and ignore cancellation; `frozen`, stop as in a debugger; `die`.
"""

import importlib
import json
import os
import signal
import time

import psycopg

from service.foundation.settings import Settings


def run(settings: Settings, job: str) -> None:
    """Run a job."""
    with psycopg.connect(settings.database_url, autocommit=True) as connection:
        if not _change_state(connection, job, "queued", "running", "started", "attempts = attempts + 1, "):
            return
        while True:
            do, cancel = connection.execute(
                "SELECT request, cancel_requested FROM jobs WHERE id = %s", [job]
            ).fetchone()
            beat = "UPDATE jobs SET heartbeat_at = %s, progress = %s WHERE id = %s AND state = 'running'"
            connection.execute(beat, [repr(time.time()), json.dumps({"stage": "light", "process": os.getpid()}), job])
            match do["do"]:
                case "finish":
                    _change_state(connection, job, "running", "succeeded", "done", "version = 1, ")
                    return
                case "wait" if cancel:
                    _change_state(connection, job, "running", "cancelled", "obeyed")
                    return
                case "frozen":
                    os.kill(os.getpid(), signal.SIGSTOP)
                case "die":
                    os._exit(3)
            time.sleep(0.05)


def _change_state(
    connection: psycopg.Connection, job: str, before: str, state: str, message: str, more: str = ""
) -> bool:
    entry = json.dumps([{"at": "", "state": state, "message": message}])
    change = f"UPDATE jobs SET {more} state = %s, history = history::jsonb || %s::jsonb WHERE id = %s AND state = %s"
    return connection.execute(change, [state, entry, job, before]).rowcount == 1


if __name__ == "__main__":
    from service.cli.main import main
    from service.training import worker

    # under the name by which its processes import it
    worker.run = importlib.import_module("tests.system.cluster.light").run
    main()
