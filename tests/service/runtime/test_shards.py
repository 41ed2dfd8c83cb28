"""Sums over shards: equal bits in any order of completion, and no shard is lost with its worker."""

import random
import threading
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lipcore.estimators.hyperparameters import FitCancelledError
from service.foundation.settings import Settings
from service.runtime import executors
from service.runtime.executors import MAX_SHARDS_AHEAD, Inline, ShardFailedError, shard_executor, sum_shards
from tests.service.runtime.work import kill_on_first_attempt, ordered_floats, suspend_on_first_attempt

SHARDS = list(range(37))


@pytest.fixture(autouse=True, scope="module")
def _wait_briefly():
    """Shorten the executors' wait, so that each check of the stop condition comes soon."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(executors, "POLL_S", 0.001)
        yield


def kill_always(shard: int) -> np.ndarray:
    """Kill the process in every attempt."""
    raise BrokenProcessPool(f"shard {shard}")


def never() -> bool:
    return False


def pairwise_sum(parts: list[np.ndarray]) -> np.ndarray:
    """Return the reference sum: the largest power of two first, halved again and again."""
    if len(parts) == 1:
        return parts[0]
    half = 1 << ((len(parts) - 1).bit_length() - 1)
    return pairwise_sum(parts[:half]) + pairwise_sum(parts[half:])


class ShuffledExecutor(Executor):
    """An executor that completes its work in an order of its own."""

    def __init__(self, seed: int) -> None:
        self.rng, self.waiting = random.Random(seed), []

    def submit(self, fn, /, *args, **kwargs):
        future: Future = Future()
        self.waiting.append((future, partial(fn, *args, **kwargs)))
        return future

    def complete_one(self) -> bool:
        """Complete one piece of work; called with every check of the stop condition."""
        if self.waiting and self.rng.random() < 0.7:
            future, call = self.waiting.pop(self.rng.randrange(len(self.waiting)))
            if self.rng.random() < 0.1:
                future.set_exception(CancelledError())  # as if its worker had died
            else:
                future.set_result(call())
        return False


@given(count=st.integers(1, 90), seed=st.integers(0, 10**6))
def test_sum_does_not_depend_on_the_order(count, seed):
    executor = ShuffledExecutor(seed)
    shards = list(range(count))
    found = sum_shards(executor, ordered_floats, shards, executor.complete_one, attempts=1000)
    assert found.tobytes() == sum_shards(Inline(), ordered_floats, shards, never).tobytes()
    assert found.tobytes() == pairwise_sum([ordered_floats(each) for each in shards]).tobytes()


@pytest.mark.slow
@pytest.mark.parametrize(("work", "shards"), [(kill_on_first_attempt, {"3", "20"}), (suspend_on_first_attempt, {"3"})])
def test_lost_or_hanging_process_costs_its_shard_another_attempt(tmp_path, monkeypatch, work, shards):
    monkeypatch.setattr(executors, "HEARTBEAT_S", 3.0)
    expected = sum_shards(Inline(), ordered_floats, SHARDS, never)
    with shard_executor(Settings(home=tmp_path, statistics_workers=2, training_cpus=2)) as executor:
        found = sum_shards(executor, partial(work, str(tmp_path)), SHARDS, never)
    assert found.tobytes() == expected.tobytes()
    assert shards <= {path.name for path in tmp_path.iterdir()}


def test_progress_counts_added_shards():
    seen = []
    sum_shards(Inline(), ordered_floats, SHARDS, never, done=seen.append)
    assert seen == [each + 1 for each in SHARDS]


def test_error_of_the_work_is_raised():
    with pytest.raises(TypeError):
        sum_shards(Inline(), len, SHARDS, never)
    with pytest.raises(ShardFailedError, match="shard 1 of 37: its worker was lost 3 times"):
        sum_shards(Inline(), kill_always, SHARDS, never)


def test_sum_can_be_cancelled():
    release, begun = threading.Event(), []

    def slow(shard: int) -> np.ndarray:
        begun.append(shard)
        release.wait(60)
        return ordered_floats(shard)

    try:
        with ThreadPoolExecutor(1) as pool:
            with pytest.raises(FitCancelledError):
                sum_shards(pool, slow, SHARDS, lambda: bool(begun))
            release.set()
        assert len(begun) <= 2  # waiting work was withdrawn
    finally:
        release.set()


def test_number_of_waiting_results_is_limited():
    """The first shard completes last: the others wait for it, and no further ones begin meanwhile."""
    first, begun = Future(), []

    class LateExecutor(Inline):
        def submit(self, fn, /, *args, **kwargs):
            begun.append(args[0])
            return first if args[0] == 0 else super().submit(fn, *args, **kwargs)

    looks = iter(range(3 * MAX_SHARDS_AHEAD))

    def look() -> bool:
        if next(looks, None) == 3 * MAX_SHARDS_AHEAD - 1:
            assert len(begun) == MAX_SHARDS_AHEAD
            first.set_result(ordered_floats(0))
        return False

    shards = list(range(2 * MAX_SHARDS_AHEAD))
    found = sum_shards(LateExecutor(), ordered_floats, shards, look)
    assert found.tobytes() == sum_shards(Inline(), ordered_floats, shards, never).tobytes()
    assert sorted(begun) == shards
