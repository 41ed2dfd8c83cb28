"""Work functions for shards in tests; the module imports quickly in a process of its own."""

import os
import signal

import numpy as np


def ordered_floats(shard: int) -> np.ndarray:
    """Return numbers whose sum depends on its order."""
    rng = np.random.default_rng(shard)
    return rng.standard_normal(50) * 10.0 ** rng.integers(-8, 8, 50)


def kill_on_first_attempt(folder: str, shard: int) -> np.ndarray:
    """Return the same numbers, but kill the process in the first attempt at two of the shards."""
    return _signal_on_first_attempt(signal.SIGKILL, folder, shard, (3, 20))


def suspend_on_first_attempt(folder: str, shard: int) -> np.ndarray:
    """Return the same numbers, but suspend the process in the first attempt at one of the shards."""
    return _signal_on_first_attempt(signal.SIGSTOP, folder, shard, (3,))


def _signal_on_first_attempt(sent: signal.Signals, folder: str, shard: int, shards: tuple[int, ...]) -> np.ndarray:
    mark = os.path.join(folder, str(shard))
    if shard in shards and not os.path.exists(mark):
        open(mark, "w").close()
        os.kill(os.getpid(), sent)
    return ordered_floats(shard)


def home_length(shard: int) -> np.ndarray:
    """Return the length of the home's path in the process that does the work."""
    from service.runtime.executors import choose_settings

    return np.array([len(str(choose_settings(None).home))])
