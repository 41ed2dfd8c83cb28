"""Holding data out from the command line and by the client."""

from __future__ import annotations

import json

import pytest

from service.cli.simulate import write_recording
from service.client import ApiError, Client
from tests.service.cli.conftest import QUICKLY
from tests.service.data import QUICK, stream


def test_from_a_recording_to_figures_on_what_was_held_out(lipserve, server, tmp_path):
    path = tmp_path / "stream.npz"
    write_recording(path, stream(samples=120, rate=10.0, seed=11))
    asked = ("--hold-out", 0.25, "--hold-out-by", "blocks")
    code, said, err = lipserve("train", path, "--model", "cli-held", "--url", server.url, *asked, *QUICKLY)
    assert code == 0, err
    assert "cli-held version 1 is trained" in said
    held = server.client.get("/v1/models/cli-held/versions/1").json()["lineage"]["holdout"]
    assert (held["split"]["kind"], held["split"]["share"]) == ("blocks", 0.25)
    assert f"on {held['samples']} samples held out" in said
    assert f"{held['nmse'][1]:.2e}" in said

    dataset = held["datasets"][0]["id"]
    code, said, err = lipserve("evaluate", "cli-held", dataset, "--held-out", "--url", server.url)
    assert code == 0, err
    assert f"on {held['samples']} held-out samples of {dataset}" in said
    assert f"{held['rmse'][0]:.4f}" in said
    code, said, _ = lipserve("evaluate", "cli-held", dataset, "--url", server.url, "--json")
    assert json.loads(said)["part"] == "all"
    code, said, _ = lipserve("evaluate", "cli-held", dataset, "--url", server.url)
    assert "which it was trained on" in said


def test_mistakes_are_passed_on(lipserve, server, tmp_path):
    path = tmp_path / "stream.npz"
    write_recording(path, stream(samples=60, rate=10.0, seed=12))
    code, _, err = lipserve("train", path, "--model", "m", "--url", server.url, "--hold-out-by", "rows")
    assert code == 1
    assert "holdout.kind" in err
    code, _, err = lipserve("evaluate", "panda-sim", "ds_nowhere", "--held-out", "--url", server.url)
    assert (code, "ds_nowhere" in err) == (1, True)


def test_the_client_holds_out_and_evaluates(server, tmp_path):
    path, unused = tmp_path / "stream.npz", tmp_path / "unused.npz"
    write_recording(path, stream(samples=120, rate=10.0, seed=13))
    write_recording(unused, stream(samples=60, rate=10.0, seed=14))
    with Client(server.url) as client:
        dataset, other = client.upload(path).id, client.upload(unused).id
        job = client.wait(
            client.train("client-held", [dataset], "lip-chain", options=QUICK, holdout={"kind": "last"}).id
        )
        assert job.holdout is not None
        assert (job.state, job.holdout.share) == ("succeeded", 0.3)
        assert client.evaluate("client-held", dataset, part="held_out").samples == 34
        assert client.evaluate("client-held", dataset).samples == 120
        with pytest.raises(ApiError, match="has held nothing out"):
            client.evaluate("client-held", other, part="held_out")
