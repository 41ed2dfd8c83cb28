"""Progress of uploads and jobs in a terminal."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from service.cli.simulate import write_recording
from service.client import progress
from service.client.progress import follow, upload_bar
from tests.service.data import ENDLESS, QUICK, running, stream, upload


def console(terminal: bool) -> Console:
    return Console(file=io.StringIO(), force_terminal=terminal, width=100, color_system=None)


@pytest.fixture
def shown(monkeypatch):
    """What is shown where nobody names a console."""
    made = console(True)
    monkeypatch.setattr(progress, "Console", lambda **_: made)
    return made.file


def test_an_upload_shows_how_far_it_is(local, tmp_path, shown):
    write_recording(tmp_path / "arm.npz", stream(seed=91))
    local.upload(tmp_path / "arm.npz", progress=True)
    assert "uploading arm.npz: sent, being read" in shown.getvalue()


def test_bytes_pass_the_bar_as_they_are():
    said = console(True)
    with upload_bar("uploading", 5, said) as passed:
        assert list(passed(iter([b"abc", b"de"]))) == [b"abc", b"de"]
    assert "5/5 bytes" in said.file.getvalue()


def test_waiting_shows_how_far_a_job_is(local, pendulum, shown):
    job = local.train("shown", [pendulum["id"]], "lip-chain", options=QUICK)
    assert local.wait(job, progress=True).state == "succeeded"
    assert "done" in shown.getvalue()
    assert "100 %" in shown.getvalue()


def test_lines_where_there_is_no_terminal(local, pendulum):
    said = console(False)
    job = follow(local, local.train("lines", [pendulum["id"]], "lip-chain", options=QUICK), said)
    assert "100%" in said.file.getvalue().splitlines()[-1]
    assert job.state == "succeeded"


def test_ctrl_c_cancels(api, local, monkeypatch):
    dataset = upload(api, stream("panda", samples=200))["id"]
    job = local.train("interrupted", [dataset], "lip-chain", options=ENDLESS)
    running(api, job.id)
    looks = iter([KeyboardInterrupt])
    ask = local.job

    def interrupted(name):
        for error in looks:
            raise error
        return ask(name)

    monkeypatch.setattr(local, "job", interrupted)
    said = console(False)
    assert follow(local, job, said).state == "cancelled"
    assert "cancelling" in said.file.getvalue()
