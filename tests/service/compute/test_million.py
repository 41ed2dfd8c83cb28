"""A million samples of seven joints, in several data sets: trained in a process of bounded memory."""

import io

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lipcore.data.samples import Samples
from service.foundation.states import ACTIVE
from tests.service.data import eventually, job, post, queue, stream
from tests.service.server import Server

SHARDS, EPISODES, LENGTH = 5, 40, 5000
MOST_MB = 2000
"""Resident memory of the training process, libraries included."""
LONGEST_S = 3600.0
OPTIONS = {"hyperparameter_samples": 60, "max_iterations": 3, "starts": 1, "max_inducing_outputs": 600}


def parquet(shard: int) -> bytes:
    """Motions repeated with fresh noise: the pass costs the same, and simulating takes seconds."""
    motions: list[Samples] = [stream("panda", LENGTH, seed, rate=100.0, noise=0.05) for seed in range(8)]
    parts = [motions[(shard + each) % len(motions)] for each in range(EPISODES)]
    table = {"t": np.concatenate([part.t for part in parts]), "episode": np.repeat(np.arange(EPISODES), LENGTH)}
    rng = np.random.default_rng(shard)
    for name in ("q", "dq", "ddq", "tau"):
        values = np.concatenate([getattr(part, name) for part in parts])
        values = values + 0.02 * rng.standard_normal(values.shape) if name == "tau" else values
        table |= {f"{name}{joint}": column for joint, column in enumerate(values.T, start=1)}
    file = io.BytesIO()
    pq.write_table(pa.table(table), file)
    return file.getvalue()


@pytest.mark.slow
def test_a_million_samples_are_trained_in_bounded_memory(tmp_path):
    with Server(tmp_path / "home", LIPSERVE_TRAINING_NICENESS="0") as server:
        server.client.timeout = 600
        answers = [post(server.client, parquet(each), "application/vnd.apache.parquet") for each in range(SHARDS)]
        assert [answer.status_code for answer in answers] == [201] * SHARDS, answers[0].text
        names = [answer.json()["id"] for answer in answers]
        held = {"kind": "last", "share": 0.1}
        made = queue(server.client, "million", *names, options=OPTIONS, holdout=held)["id"]
        seen = eventually(lambda: (now := job(server.client, made))["state"] not in ACTIVE and now, LONGEST_S)
        assert seen["state"] == "succeeded", seen
        version = server.client.get("/v1/models/million/versions/1").json()
    lineage, rows = version["lineage"], SHARDS * EPISODES * LENGTH
    assert version["fit"]["samples_posterior"] == version["fit"]["samples_given"] > 0.89 * rows
    assert lineage["holdout"]["of"] >= 0.09 * rows
    assert lineage["training_process"]["peak_memory_mb"] < MOST_MB
    assert max(lineage["holdout"]["nmse"]) < 0.05
