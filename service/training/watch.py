"""When a training process has to be ended: it does not obey, gives no sign of life, or takes too long."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from service.foundation.settings import Settings
from service.foundation.states import ACTIVE, RUNNING

Why = Literal["returned", "ended", "cancelled", "silent", "too_long", "not_started", "lingering", "refused"]
LINGER_S = 10.0
"""Seconds that a process may take to tidy up after the end of its job."""
AWAY_S = 0.5
"""Seconds by which the host of a process on another machine, which judges it too, is waited for."""


@dataclass(frozen=True)
class Facts:
    """What a job's row says of it. attempts: how often it was started; ours: whether it still is this service's."""

    state: str
    heartbeat_at: str | None
    cancel_requested: bool
    attempts: int = 0
    ours: bool = True


@dataclass(frozen=True)
class Ended:
    """A job whose process no longer runs it. message: why, in words; attempt: which one it was, None: the last one."""

    job: str
    why: Why
    message: str
    attempt: int | None = None


@dataclass(eq=False)
class Hand:
    """A job in the hands of a process. Times are monotonic, s: steps of the wall clock, or a machine that slept, are
    no silence.

    slot: the place of the process, and future: its end, as the kind of queue has them; away: it is the process of a
    worker elsewhere, for which the job may have to wait; since: when it was handed over; ran, stopped, done: when it
    was first seen to run, to be cancelled and to have ended; heartbeat: the last one seen, and heard: when.
    """

    job: str
    slot: Any
    future: Any
    since: float
    away: bool = False
    ran: float | None = None
    stopped: float | None = None
    done: float | None = None
    heartbeat: str | None = None
    heard: float = 0.0

    def see(self, facts: Facts, clock: float) -> None:
        """Take note of what the row says."""
        if facts.state == RUNNING and self.ran is None:
            self.ran = self.heard = clock
        if facts.heartbeat_at != self.heartbeat:
            self.heartbeat, self.heard = facts.heartbeat_at, clock
        if facts.cancel_requested:
            self.stop(clock)
        if (facts.state not in ACTIVE or not facts.ours) and self.done is None:
            self.done = clock

    def stop(self, clock: float) -> None:
        """Take note of the wish to cancel: it counts once the process has begun."""
        if self.ran is not None and self.stopped is None:
            self.stopped = clock

    def judge(self, settings: Settings, clock: float) -> Ended | None:
        """Why the process has to be ended now, None while it need not be."""
        if self.away:
            if self.done is not None:
                return Ended(self.job, "returned", "it has ended, or is another service's")
            clock -= AWAY_S
        if self.done is not None:
            late = clock - self.done >= LINGER_S
            return Ended(self.job, "lingering", "the process did not go on after its end") if late else None
        if self.stopped is not None:
            if clock - self.stopped < settings.job_cancel_grace_s:
                return None
            message = f"the training process did not stop within {settings.job_cancel_grace_s:g} s and was ended"
            return Ended(self.job, "cancelled", message)
        if self.ran is None:
            if self.away or clock - self.since < settings.job_start_s:
                return None
            return Ended(self.job, "not_started", f"no training process was ready within {settings.job_start_s:g} s")
        if clock - self.heard >= settings.job_heartbeat_s:
            message = f"the training process gave no sign of life for {settings.job_heartbeat_s:g} s and was ended"
            return Ended(self.job, "silent", message)
        if clock - self.ran >= settings.max_job_s:
            return Ended(self.job, "too_long", f"it ran for {settings.max_job_s:g} s, the longest that a job may")
        return None
