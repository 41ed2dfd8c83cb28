"""Quick functions that replace the fit of training processes in tests of the queue.

They use the database without SQLAlchemy, whose import would take longer than all their work.
"""

import os
import signal
import sqlite3
import time

from service.foundation.settings import Settings


def connect(settings: Settings) -> sqlite3.Connection:
    return sqlite3.connect(settings.home / "lipserve.sqlite3", timeout=30, isolation_level=None)


def change_state(connection: sqlite3.Connection, job: str, before: str, state: str, message: str) -> bool:
    """Change a job's state and record it in its history, if it still has the state `before`."""
    entry = """json_insert(history, '$[#]', json_object('at', '', 'state', ?, 'message', ?))"""
    change = f"UPDATE jobs SET state = ?, history = {entry} WHERE id = ? AND state = ?"
    return connection.execute(change, (state, state, message, job, before)).rowcount == 1


def claim(settings: Settings, job: str) -> sqlite3.Connection | None:
    connection = connect(settings)
    connection.execute("BEGIN IMMEDIATE")
    claimed = change_state(connection, job, "queued", "running", "started")
    if claimed:
        values = "attempts = attempts + 1, heartbeat_at = '0', progress = json_object('process', ?)"
        connection.execute(f"UPDATE jobs SET {values} WHERE id = ?", (os.getpid(), job))
    connection.execute("COMMIT")
    return connection if claimed else None


def succeed(settings: Settings, job: str) -> None:
    """Complete the job at once."""
    if connection := claim(settings, job):
        connection.execute("UPDATE jobs SET version = 1, finished_at = ? WHERE id = ?", (repr(time.time()), job))
        change_state(connection, job, "running", "succeeded", "done")


def ignore_cancel(settings: Settings, job: str) -> None:
    """Run for ever with a heartbeat, and ignore a cancel."""
    connection, beat = claim(settings, job), 0
    while connection:
        beat += 1
        connection.execute("UPDATE jobs SET heartbeat_at = ? WHERE id = ?", (str(beat), job))
        time.sleep(0.05)


def suspend_self(settings: Settings, job: str) -> None:
    """Begin, and suspend the process, as a debugger does."""
    if claim(settings, job):
        os.kill(os.getpid(), signal.SIGSTOP)


def suspend_self_with_lock(settings: Settings, job: str) -> None:
    """Begin, and suspend the process while it holds the database's write lock."""
    if connection := claim(settings, job):
        connection.execute("BEGIN IMMEDIATE")
        (settings.home / "locked").touch()
        os.kill(os.getpid(), signal.SIGSTOP)


def exit_before_start(settings: Settings, job: str) -> None:
    """Exit before the job has begun, like a process that gets no memory."""
    os._exit(3)


def exit_in_first_attempt(settings: Settings, job: str) -> None:
    """Exit in the first attempt once the test allows it; complete the job in the second attempt."""
    (attempts,) = connect(settings).execute("SELECT attempts FROM jobs WHERE id = ?", (job,)).fetchone()
    if attempts:
        succeed(settings, job)
    elif claim(settings, job):
        (settings.home / "versions" / f".draft-mv_0_{job.removeprefix('job_')}-x").mkdir()
        while not (settings.home / "die").exists():
            time.sleep(0.02)
        os._exit(1)
