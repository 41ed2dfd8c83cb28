"""Sentences for people: why a version serves or not, and what happened to a job."""

from __future__ import annotations

from collections.abc import Sequence

TAKEN_BACK = "observations that it was trained on have been unlearnt or rolled back meanwhile: refresh again"
CANCELLED_WAITING = "cancelled while waiting"
CANCELLED_RUNNING = "cancelled while running"
CANCEL_REQUESTED = "cancellation requested"
SERVICE_STOPPED = "the service was stopped while the job ran"
SERVICE_KILLED = "the service was killed while the job ran"
SERVICE_GONE = "the service that ran the job is gone"
WORKER_STOPPED = "the worker was stopped while the job ran"
WORKER_GONE = "the worker that ran the job is gone"
NO_PROCESS = "no process runs the job"
RETURNED = "the training process has returned"
ENDED_ELSEWHERE = "it has ended, or belongs to another service"
LINGERS = "the training process was not free after the end of the job"


def describe_started(attempt: int, most: int) -> str:
    """State that an attempt at a job has started."""
    return f"started: attempt {attempt} of at most {most}"


def describe_queued(retry_of: str | None) -> str:
    """State that a job was queued."""
    return "queued" if retry_of is None else f"queued to repeat {retry_of}"


def describe_unstoppable(seconds: float) -> str:
    """State that a process ignored its cancellation."""
    return f"the training process did not stop within {seconds:g} s and was killed"


def describe_not_ready(seconds: float) -> str:
    """State that no process started in time."""
    return f"no training process was ready within {seconds:g} s"


def describe_no_progress(seconds: float) -> str:
    """State that a process was killed without progress."""
    return f"the training process made no progress for {seconds:g} s and was killed"


def describe_too_long(seconds: float) -> str:
    """State that a job reached its time limit."""
    return f"it reached the time limit of a job, {seconds:g} s (LIPSERVE_MAX_JOB_S)"


def describe_start_failure(error: object) -> str:
    """State that no process could be started."""
    return f"a training process could not be started: {error}"


def describe_process_failure(error: object) -> str:
    """State that a process failed."""
    return f"the training process failed: {error}"


def describe_cluster_wait(gpu: bool) -> str:
    """State that a job waits for the cluster."""
    return f"waiting for a worker of the cluster{' with a GPU' if gpu else ''}"


def describe_outcome(version: int, outcome: str) -> str:
    """Return the last entry of a job that has succeeded."""
    return f"version {version} is trained and {outcome}"


def describe_promotion(serves: bool, reason: str) -> str:
    """Return whether a trained version serves. reason: sentences."""
    return f"{'is now serving' if serves else 'is a candidate'}: {reason}"


def describe_refresh(version: int, reason: str, better: bool, promoted: bool) -> str:
    """Return what becomes of a refreshed version."""
    if promoted:
        return f"is now serving: {reason}"
    if better:
        return f"is a candidate: {reason} Roll back to version {version} to let it serve."
    return f"is dismissed: {reason}"


def describe_changed_serving(serving: int) -> str:
    """State that another version has become the serving version since the comparison."""
    return f"It was not compared with version {serving}, which became the serving version meanwhile."


def describe_other_robot(name: str) -> str:
    """State that the serving version is of another robot."""
    return f"{_start(name)} is of another robot."


def describe_foreign_recording(name: str, joints: Sequence[str]) -> str:
    """State that the serving version does not describe a recording at all."""
    return (
        f"On this recording, the errors of {name} are no smaller than with the mean torque ({', '.join(joints)}). Is "
        "it the same robot, with the same payload and torque unit?"
    )


def describe_unreadable(name: str) -> str:
    """State that the serving version cannot be read."""
    return f"It was not compared with {name}, which cannot be read."


def describe_learnt_held_out(name: str) -> str:
    """State that the serving version has learnt the held-out rows."""
    return f"It was not compared with {name}, which was trained on the held-out rows."


def describe_too_short(name: str) -> str:
    """State that the held-out rows are too few for a comparison."""
    return f"It was not compared with {name}, because too few rows are held out."


def describe_too_few_logged(name: str) -> str:
    """State that the logged rows are too few for a comparison."""
    return f"It was not compared with {name}, because too few rows are logged."


def describe_density(how: str, name: str, difference: float, half_width: float) -> str:
    """Return how predictions of the held-out rows compare. how: "better", "worse" or "no worse"."""
    amount = f"negative log density {difference:+.3g} ± {half_width:.2g} nats per sample"
    return f"Its predictions of the held-out rows are {how} than those of {name} ({amount})."


def describe_larger_errors(name: str, difference: float, half_width: float) -> str:
    """State that errors are larger than those of the serving version."""
    return f"Its errors are larger than those of {name} (mean nMSE {difference:+.2g} ± {half_width:.1g})."


def describe_newest_rows(better: bool, name: str, difference: float, half_width: float) -> str:
    """Return how predictions of the newest logged rows compare."""
    amount = f"negative log density {difference:+.3g} ± {half_width:.2g} nats per row"
    how = "better" if better else "no better"
    return f"Its predictions of the newest logged rows are {how} than those of {name} ({amount})."


def _start(name: str) -> str:
    return f"{name[0].upper()}{name[1:]}"
