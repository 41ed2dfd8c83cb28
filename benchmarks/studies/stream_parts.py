"""Time of gravity, Coriolis torque and mass matrix beside a torque, over a stream and in process.

    python benchmarks/studies/stream_parts.py [MODEL [URL]]

A service runs at URL. In process, the shipped Panda is used. Calls alternate, so that a busy machine slows all of them:
compare the ratios.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from time import perf_counter

import numpy as np

import lipcore
from lipserve import StreamClient

PANDA = Path(__file__).parents[2] / "models/panda-sim"
ROUNDS = 3000


def report(title: str, calls: dict[str, Callable[[], object]]) -> None:
    """Print the median time of each call, µs, and its ratio to that of the first."""
    for call in calls.values():
        call()
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(ROUNDS):
        for name, call in calls.items():
            began = perf_counter()
            call()
            taken[name].append(1e6 * (perf_counter() - began))
    medians = {name: float(np.median(each)) for name, each in taken.items()}
    first = next(iter(medians.values()))
    print(title, *(f"  {name:22} {each:6.0f} µs  {each / first:5.2f}" for name, each in medians.items()), sep="\n")


def main(model: str = "panda-sim", url: str = "http://127.0.0.1:8000") -> None:
    """Measure both."""
    with StreamClient(model, url, timeout=10.0) as stream:
        q, dq, ddq = np.full((3, len(stream.hello.joint_names)), [[0.2], [0.1], [0.3]])
        report(
            f"{model}, stream",
            {
                "torque, std": lambda: stream.predict(q, dq, ddq),
                "torque": lambda: stream.predict(q, dq, ddq, std=False),
                "gravity, std": lambda: stream.gravity(q),
                "gravity": lambda: stream.gravity(q, std=False),
                "Coriolis torque": lambda: stream.coriolis(q, dq),
                "mass matrix": lambda: stream.mass_matrix(q),
            },
        )
    panda, motion = lipcore.load(PANDA), np.full((3, 7), 0.2)
    report(
        "shipped Panda, in process",
        {
            "torque, std": lambda: panda.answer(motion),
            "gravity, std": lambda: panda.gravity(motion[0]),
            "Coriolis torque": lambda: panda.coriolis(motion[0], motion[1]),
            "mass matrix": lambda: panda.mass_matrix(motion[0]),
        },
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
