"""Progress of uploads and jobs in a terminal."""

import io

import pytest
from rich.console import Console

from lipserve import progress
from lipserve.progress import follow, upload_bar
from service.cli.simulate import write_recording
from tests.service.data import ENDLESS, QUICK, stream, upload


def console(terminal: bool) -> Console:
    return Console(file=io.StringIO(), force_terminal=terminal, width=100, color_system=None)


@pytest.fixture
def shown(monkeypatch):
    """Output on the default console."""
    made = console(True)
    monkeypatch.setattr(progress, "Console", lambda **_: made)
    return made.file


def test_upload_shows_progress(local, tmp_path, shown):
    write_recording(tmp_path / "arm.npz", stream(seed=91))
    local.upload(tmp_path / "arm.npz", progress=True)
    assert "uploading arm.npz: sent, service is reading it" in shown.getvalue()
    at = console(True)
    with upload_bar("uploading", 5, at) as passed:
        assert list(passed(iter([b"abc", b"de"]))) == [b"abc", b"de"]
    assert "5/5 bytes" in at.file.getvalue()


def test_wait_shows_progress_with_and_without_terminal(local, pendulum, shown):
    jobs = [local.train("shown", [pendulum["id"]], "lip-chain", options=QUICK) for _ in range(2)]
    assert local.wait(jobs[0], progress=True).state == "succeeded"
    assert "done" in shown.getvalue()
    assert "100 %" in shown.getvalue()
    plain = console(False)
    assert follow(local, jobs[1], plain).state == "succeeded"
    assert "100 %" in plain.file.getvalue().splitlines()[-1]


@pytest.mark.slow
def test_ctrl_c_cancels_the_job(api, local, monkeypatch):
    dataset = upload(api, stream("panda", samples=200))["id"]
    job = local.train("interrupted", [dataset], "lip-chain", options=ENDLESS)
    ask, looks = local.job, iter([KeyboardInterrupt])

    def interrupted(name):
        if interruption := next(looks, None):
            raise interruption
        return ask(name)

    monkeypatch.setattr(local, "job", interrupted)
    at = console(False)
    assert follow(local, job, at).state == "cancelled"
    assert "cancelling" in at.file.getvalue()
