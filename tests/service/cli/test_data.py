"""`lipserve data`: recordings in, reports out."""

from __future__ import annotations

import json

import pytest

from service.cli.simulate import write_recording
from tests.service.data import stream


@pytest.fixture
def data(server, lipserve):
    """Run `lipserve data` with arguments against a service; return its exit code and all that it printed."""

    def run(command, *arguments):
        code, said, err = lipserve("data", command, *arguments, "--url", server.url)
        return code, said or err

    return run


@pytest.fixture
def path(tmp_path):
    found = tmp_path / "two-joints.csv"
    write_recording(found, stream(samples=600, rate=100.0, seed=72))
    return found


def test_an_upload_prints_its_report(data, path):
    code, said = data("add", path, "--joint-names", "shoulder,elbow", "--filtering", "always", "--rate", 50)
    assert code == 0, said
    assert "two-joints.csv" in said
    assert "low-passed at 4 Hz" in said
    assert "shoulder" in said
    assert "Coulomb" in said


def test_what_is_added_is_listed_and_shown(data, path):
    code, said = data("add", path, "--name", "monday", "--column", "q=q{joint}", "--unit", "t=s", "--json")
    assert code == 0, said
    added = json.loads(said)
    assert added["name"] == "monday"
    code, said = data("list")
    assert code == 0
    assert next(line for line in said.splitlines() if added["id"] in line).count("monday") == 1
    code, said = data("show", added["id"], "--json")
    assert (code, json.loads(said)) == (0, added)
    code, said = data("list", "--json")
    assert added in json.loads(said)


def test_what_is_wrong_is_said(data, path):
    code, said = data("add", path, "--unit", "deg")
    assert code != 0
    code, said = data("show", "ds_none")
    assert code == 1
    assert "no dataset 'ds_none'" in said
    code, said = data("add", path, "--effort", "volts")
    assert code == 1
    assert "effort" in said
