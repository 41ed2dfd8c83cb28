"""What training processes do in tests of the queue: light functions instead of a fit, in real processes.

They speak to the database without SQLAlchemy, whose import would take longer than all that they do.
"""

import os
import signal
import sqlite3
import time

from service.foundation.settings import Settings


def connect(settings: Settings) -> sqlite3.Connection:
    return sqlite3.connect(settings.home / "lipserve.sqlite3", timeout=30, isolation_level=None)


def enter(connection: sqlite3.Connection, job: str, before: str, state: str, message: str) -> bool:
    """Change a job's state and note it, if it still has the state `before`."""
    entry = """json_insert(history, '$[#]', json_object('at', '', 'state', ?, 'message', ?))"""
    change = f"UPDATE jobs SET state = ?, history = {entry} WHERE id = ? AND state = ?"
    return connection.execute(change, (state, state, message, job, before)).rowcount == 1


def claim(settings: Settings, job: str) -> sqlite3.Connection | None:
    connection = connect(settings)
    connection.execute("BEGIN IMMEDIATE")
    claimed = enter(connection, job, "queued", "running", "started")
    if claimed:
        values = "attempts = attempts + 1, heartbeat_at = '0', progress = json_object('process', ?)"
        connection.execute(f"UPDATE jobs SET {values} WHERE id = ?", (os.getpid(), job))
    connection.execute("COMMIT")
    return connection if claimed else None


def well(settings: Settings, job: str) -> None:
    """Does the job at once."""
    if connection := claim(settings, job):
        connection.execute("UPDATE jobs SET version = 1, finished_at = ? WHERE id = ?", (repr(time.time()), job))
        enter(connection, job, "running", "succeeded", "done")


def deaf(settings: Settings, job: str) -> None:
    """Lives, and says so, but never looks whether it is to end."""
    connection, beat = claim(settings, job), 0
    while connection:
        beat += 1
        connection.execute("UPDATE jobs SET heartbeat_at = ? WHERE id = ?", (str(beat), job))
        time.sleep(0.05)


def frozen(settings: Settings, job: str) -> None:
    """Begins and is suspended, as by a debugger."""
    if claim(settings, job):
        os.kill(os.getpid(), signal.SIGSTOP)


def frozen_with_the_lock(settings: Settings, job: str) -> None:
    """Begins, and is suspended while nobody else may write."""
    if connection := claim(settings, job):
        connection.execute("BEGIN IMMEDIATE")
        (settings.home / "locked").touch()
        os.kill(os.getpid(), signal.SIGSTOP)


def stillborn(settings: Settings, job: str) -> None:
    """Ends before it has begun, as a process for which there is no memory."""
    os._exit(3)


def frail(settings: Settings, job: str) -> None:
    """Ends in its first attempt, once the test wants it; does the job in the second one."""
    (attempts,) = connect(settings).execute("SELECT attempts FROM jobs WHERE id = ?", (job,)).fetchone()
    if attempts:
        well(settings, job)
    elif claim(settings, job):
        (settings.home / "versions" / f".draft-mv_0_{job.removeprefix('job_')}-x").mkdir()
        while not (settings.home / "die").exists():
            time.sleep(0.02)
        os._exit(1)
