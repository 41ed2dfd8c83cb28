"""Error and coverage for several numbers of rows a second that count as independent.

    python benchmarks/studies/independent_rows.py [SPEED...]

A simulated Panda with friction that no estimator expresses exactly (a jump at zero speed) learns from a 1 kHz stream
for 30 s without and 30 s with a payload of 1.5 kg. The test is another trajectory under the same dynamics: nMSE, and
coverage of the 95 % interval, noise included, are means over the joints.
"""

import sys
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

import lipcore
from benchmarks.online.scene import Scene, rows_of
from lipcore.data.independence import stream_weights
from lipcore.data.metrics import evaluate
from lipcore.online.learner import OnlineModel

RATES = (1000.0, 100.0, 50.0, 20.0, 10.0, 5.0)
OPTIONS = lipcore.FitOptions(max_inducing_outputs=500, starts=1, max_iterations=80)
FORGETTING = 30.0
BLOCK = 1000


def evaluate_model(scene: Scene, online: OnlineModel, at: float) -> str:
    """Return mean nMSE and coverage on the test trajectory at a time of the stream."""
    unseen = scene.unseen(at)
    answer = online.model().predict(unseen.q, unseen.dq, unseen.ddq)
    metrics = evaluate(scene.measured(unseen), *answer.interval)
    nmse = np.mean((answer.tau - unseen.tau) ** 2, axis=0) / unseen.tau.var(axis=0)
    return f"{nmse.mean():.1e} ({metrics.coverage.mean():.0%})"


def main() -> None:
    """Learn with each number of independent rows a second; print a Markdown table."""
    threadpool_limits(1)
    print("| speed | independent rows/s | 30 s, before the payload | 5 s after | 30 s after |\n| " + "--- | " * 5)
    for speed in map(float, sys.argv[1:] or ("2", "5", "10")):
        scene = Scene(speed=speed)
        base = lipcore.train(scene.history(100, 10), scene.arm.joint_types, "lip-chain", OPTIONS)
        live, change = rows_of(scene.live()), round(scene.change_at * scene.rate)
        for rate in RATES:
            rows, found = replace(live, weight=stream_weights(live.time, rate=rate)), []
            online = OnlineModel.start(base, FORGETTING)
            for first in range(0, len(rows), BLOCK):
                if first == change:
                    online = online.change(float(rows.time[first]))
                online = online.learn(rows.take(slice(first, first + BLOCK)))
                seconds = round((first + BLOCK) / scene.rate)
                if seconds in (30, 35, 60):
                    found.append(evaluate_model(scene, online, seconds if seconds > 30 else seconds - 1e-3))
            print(f"| {speed:g} | {rate:g} | " + " | ".join(found) + " |", flush=True)


if __name__ == "__main__":
    main()
