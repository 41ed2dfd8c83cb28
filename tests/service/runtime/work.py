"""What the shards of tests are worked on by; nothing here takes long to import in a process of its own."""

import os
import signal

import numpy as np


def numbers(shard: int) -> np.ndarray:
    """Numbers whose sum depends on its order."""
    rng = np.random.default_rng(shard)
    return rng.standard_normal(50) * 10.0 ** rng.integers(-8, 8, 50)


def dying(folder: str, shard: int) -> np.ndarray:
    """The same, but the first attempt at two of the shards kills its process."""
    mark = os.path.join(folder, str(shard))
    if shard in (3, 20) and not os.path.exists(mark):
        open(mark, "w").close()
        os.kill(os.getpid(), signal.SIGKILL)
    return numbers(shard)


def freezing(folder: str, shard: int) -> np.ndarray:
    """The same, but the first attempt at one of the shards suspends its process."""
    mark = os.path.join(folder, str(shard))
    if shard == 3 and not os.path.exists(mark):
        open(mark, "w").close()
        os.kill(os.getpid(), signal.SIGSTOP)
    return numbers(shard)


def home(shard: int) -> np.ndarray:
    """The length of the name of the home of whoever does it."""
    from service.runtime.executors import choose_settings

    return np.array([len(str(choose_settings(None).home))])
