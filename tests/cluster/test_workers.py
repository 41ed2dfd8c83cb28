"""Shards on this process, on processes of this host and on workers of a Dask cluster: the same sum, to the last bit."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from lipcore.fitting.hyperparameters import FitCancelledError
from service.compute.executors import ClusterUnavailableError, Processes, lost, sent, shard_executor, summed
from service.foundation.settings import Settings
from tests.cluster.sums import home, once_lost, told
from tests.cluster.workers import cluster

SHARDS = range(21)


def summed_by(executor, work=told):
    return summed(executor, work, SHARDS, lambda: False)


def test_a_sum_does_not_depend_on_who_computes_it_nor_on_losses(tmp_path):
    with shard_executor(Settings(home=tmp_path)) as inline:
        once = summed_by(inline)
    settings = Settings(home=tmp_path, statistics_workers=2)
    with shard_executor(settings) as processes:
        assert isinstance(processes, Processes)
        assert summed_by(processes).tobytes() == once.tobytes()
        assert summed_by(processes, partial(once_lost, tmp_path / "lost")).tobytes() == once.tobytes()
    assert sent(settings) == settings
    plain = sum(told(shard) for shard in SHARDS)
    np.testing.assert_allclose(once, plain, rtol=1e-12)


def test_workers_of_a_cluster_come_to_the_same_sum_and_a_lost_one_costs_nothing(shared, tmp_path):
    with shard_executor(Settings(home=tmp_path)) as inline:
        once = summed_by(inline)
    with cluster(shared, tmp_path / "cluster", "one", "two") as workers:
        settings = shared.settings(cluster=workers.address)
        assert sent(settings) is None  # each has its own
        with shard_executor(settings) as executor:
            assert summed_by(executor).tobytes() == once.tobytes()
            lengths = {len(str(shared.home(name))) for name in ("one", "two")}
            assert summed_by(executor, home)[0] in {len(SHARDS) * length for length in lengths}
            assert summed_by(executor, partial(once_lost, tmp_path / "lost")).tobytes() == once.tobytes()
            assert summed_by(executor).tobytes() == once.tobytes()  # by the one that is left
            with pytest.raises(FitCancelledError):
                summed(executor, told, SHARDS, lambda: True)


@pytest.mark.slow
def test_without_a_scheduler_there_is_no_executor(shared):
    settings = shared.settings(cluster="tcp://127.0.0.1:1")
    with pytest.raises(ClusterUnavailableError, match="cannot be reached"), shard_executor(settings):
        pass
    assert not lost(ValueError("wrong"))
