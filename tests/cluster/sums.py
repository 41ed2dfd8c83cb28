"""Work on shards for tests: processes of their own import no more than it needs."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np


def told(shard: int) -> np.ndarray:
    """Numbers whose sum depends on its order."""
    return np.random.default_rng(shard).standard_normal(50) * 10.0 ** (shard % 7)


def once_lost(mark: Path, shard: int) -> np.ndarray:
    """As `told`; the first one who comes to shard 5 dies over it."""
    if shard == 5 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return told(shard)


def home(shard: int) -> np.ndarray:
    """Where whoever does it has its home."""
    from service.compute.executors import placed

    return np.array([len(str(placed(None).home))])
