import json

import pytest

from service import cli
from service.cli.simulate import write_recording
from tests.service.data import QUICK, stream, train, upload
from tests.service.models.versions import NO_BODIES, publish_arm_at


def options_of_train(options):
    """Return fit options as arguments of `lipserve train`."""
    values = [part for name, value in options.items() for part in ("--option", f"{name}={value}")]
    return ["--estimator", "lip-chain", *values]


def lacking(text, *parts):
    """Return the parts that a text does not contain."""
    return [part for part in parts if part not in text]


QUICKLY = options_of_train(QUICK)
"""Arguments of `lipserve train` for a fit that takes a fraction of a second."""


@pytest.fixture
def lipserve(monkeypatch, capsys):
    """Run `lipserve` with arguments; return its exit code, output and error output."""

    def run(*arguments):
        monkeypatch.setattr("sys.argv", ["lipserve", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        printed = capsys.readouterr()
        return ended.value.code or 0, printed.out, printed.err

    return run


@pytest.fixture
def run_on_server(lipserve, server):
    """Run a command against the shared service; return its exit code, output and error output."""
    return lambda *arguments: lipserve(*arguments, "--url", server.url)


@pytest.fixture
def run_command(run_on_server):
    """Run a command that succeeds; return its output, with --json as parsed JSON."""

    def run(*arguments):
        code, out, err = run_on_server(*arguments)
        assert code == 0, err
        return json.loads(out) if "--json" in arguments else out

    return run


@pytest.fixture
def run_rejected_command(run_on_server):
    """Run a command that the shared service rejects; return its error output."""

    def run(*arguments):
        code, out, err = run_on_server(*arguments)
        assert (code, out.strip()) == (1, "")
        assert "error: " in err
        return err

    return run


@pytest.fixture
def recording(tmp_path):
    """Write a recording as a file; return its path."""

    def write(seed, name="arm.npz", **options):
        write_recording(tmp_path / name, stream(seed=seed, **options))
        return tmp_path / name

    return write


@pytest.fixture(scope="session")
def arm(server):
    """Name and data set of a double pendulum with two versions in the shared service."""
    dataset = upload(server.client, stream())["id"]
    for seed in (1, 2):
        train(server.client, "cli-arm", dataset, estimator="se", options={**QUICK, "starts": seed})
    return "cli-arm", dataset


@pytest.fixture(scope="session")
def robot_arm(server):
    """Name of a model in the shared service with two versions, the second without rigid bodies."""
    publish_arm_at(server.home, "cli-robot-arm")
    publish_arm_at(server.home, "cli-robot-arm", **NO_BODIES)
    return "cli-robot-arm"
