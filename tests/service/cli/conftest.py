from __future__ import annotations

import json

import pytest

from service import cli
from tests.service.data import QUICK, stream, train, upload
from tests.service.models.arms import NO_BODIES, publish_arm_at

QUICKLY = ["--estimator", "lip-chain"]
QUICKLY += [part for name, value in QUICK.items() for part in ("--option", f"{name}={value}")]
"""Options of `lipserve train` for a fit that takes a fraction of a second."""


@pytest.fixture
def lipserve(monkeypatch, capsys):
    """Run `lipserve` with arguments; return its exit code, output and error output."""

    def run(*arguments):
        monkeypatch.setattr("sys.argv", ["lipserve", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        said = capsys.readouterr()
        return ended.value.code or 0, said.out, said.err

    return run


@pytest.fixture
def asked(lipserve, server):
    """Run a command against the shared service; return its output, or its JSON where that is asked for."""

    def run(*arguments):
        code, said, err = lipserve(*arguments, "--url", server.url)
        assert code == 0, err
        return json.loads(said) if "--json" in arguments else said

    return run


@pytest.fixture(scope="session")
def arm(server):
    """A trained double pendulum in the shared service, of two versions on one data set; its name and data set."""
    dataset = upload(server.client, stream())["id"]
    for seed in (1, 2):
        train(server.client, "cli-arm", dataset, estimator="se", options={**QUICK, "starts": seed})
    return "cli-arm", dataset


@pytest.fixture(scope="session")
def robot_arm(server):
    """Two versions in the shared service, the second without rigid bodies; the name of their model."""
    publish_arm_at(server.home, "cli-robot-arm")
    publish_arm_at(server.home, "cli-robot-arm", **NO_BODIES)
    return "cli-robot-arm"
