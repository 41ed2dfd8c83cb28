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
    mark = os.path.join(folder, str(shard))
    if shard in (3, 20) and not os.path.exists(mark):
        open(mark, "w").close()
        os.kill(os.getpid(), signal.SIGKILL)
    return ordered_floats(shard)


def suspend_on_first_attempt(folder: str, shard: int) -> np.ndarray:
    """Return the same numbers, but suspend the process in the first attempt at one of the shards."""
    mark = os.path.join(folder, str(shard))
    if shard == 3 and not os.path.exists(mark):
        open(mark, "w").close()
        os.kill(os.getpid(), signal.SIGSTOP)
    return ordered_floats(shard)


def home_length(shard: int) -> np.ndarray:
    """Return the length of the home's path in the process that does the work."""
    from service.runtime.executors import choose_settings

    return np.array([len(str(choose_settings(None).home))])
