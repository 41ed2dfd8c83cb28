"""Training processes that are killed or interrupted: the service goes on and so do the jobs."""

import multiprocessing
import os
import signal

import pytest

from tests.service.data import ENDLESS, ended, queue, running, stream, upload
from tests.service.server import command

LONG = {**ENDLESS, "hyperparameter_samples": 60, "max_iterations": 25}
"""A fit of a few seconds."""


def workers():
    """Process ids of the training processes of this process."""
    return [child.pid for child in multiprocessing.active_children() if command(child.pid)]


def test_a_job_whose_process_is_killed_is_tried_again(api):
    name = queue(api, "killed", upload(api, stream("panda", 100))["id"], options=LONG)["id"]
    running(api, name)
    for pid in workers():
        os.kill(pid, signal.SIGKILL)
    seen = ended(api, name)
    assert (seen["state"], seen["attempts"], seen["version"]) == ("succeeded", 2, 1)
    assert api.get("/v1/models/killed").json()["latest_version"] == 1


@pytest.mark.slow
def test_an_interrupt_from_the_keyboard_does_not_reach_a_job(api):
    """Ctrl-C goes to the whole process group: the service decides what becomes of its processes."""
    name = queue(api, "interrupted", upload(api, stream("panda", 100))["id"], options=LONG)["id"]
    running(api, name)
    for pid in workers():
        os.kill(pid, signal.SIGINT)
    seen = ended(api, name)
    assert (seen["state"], seen["attempts"]) == ("succeeded", 1)
