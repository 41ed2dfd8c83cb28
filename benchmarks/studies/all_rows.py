"""Error and coverage of a posterior of all rows, compared with a posterior of the rows that a fit chooses.

    python benchmarks/studies/all_rows.py [ROBOT...]

A simulated arm with friction that no estimator expresses exactly (a jump at zero speed) is learnt from episodes of 50
seconds at several rates. Each fit chooses its rows and its basis like a training job. Then the same basis is
conditioned on all rows: with weights (see `lipcore.data.independence`), and with weight 1. `effective` is the sum of
the weights. Test trajectories have twice the bandwidth; nMSE and coverage of the 95 % interval, noise included, are
means over joints and trajectories.
"""

import sys
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

import lipcore
from benchmarks.online.scene import Scene
from lipcore.data.independence import stream_weights
from lipcore.data.metrics import evaluate
from lipcore.training.conditioning import condition

GRID = ((10.0, 1), (10.0, 2), (100.0, 1), (100.0, 2), (100.0, 4), (100.0, 20), (1000.0, 2))
"""Rate in Hz, and number of episodes of SECONDS."""
SECONDS = 50
SPEEDS = (2.0, 10.0)
CANDIDATES = 20_000
OPTIONS = lipcore.FitOptions(starts=1, max_iterations=60, statistics="chosen")


def evaluate_model(model: lipcore.TorqueModel, scenes: list[Scene]) -> str:
    """Return mean nMSE and coverage on test trajectories."""
    errors, inside = [], []
    for scene in scenes:
        unseen = scene.unseen(0.0)
        answer = model.predict(unseen.q, unseen.dq, unseen.ddq)
        found = evaluate(scene.measured(unseen), *answer.interval)
        errors.append(np.mean((answer.tau - unseen.tau) ** 2, axis=0) / unseen.tau.var(axis=0))
        inside.append(found.coverage)
    return f"{np.mean(errors):.1e} ({np.mean(inside):.0%})"


def main() -> None:
    """Print a Markdown table: nMSE (coverage) of each posterior."""
    threadpool_limits(1)
    print("| robot, speed | rows | effective | chosen | all, weighted | all, weight 1 |\n| " + "--- | " * 6)
    for robot in sys.argv[1:] or ("panda", "ur5"):
        for speed in SPEEDS:
            scene = Scene(robot=robot, speed=speed)
            unseen = [replace(scene, seed=seed) for seed in (0, 1, 2)]
            for rate, episodes in GRID:
                parts = scene.fleet(episodes, round(rate * SECONDS), rate)
                samples = lipcore.Samples.concatenate(parts)
                few = np.linspace(0, len(samples) - 1, min(len(samples), CANDIDATES)).round().astype(np.int64)
                chosen = lipcore.train(samples.rows(few), scene.arm.joint_types, "lip-chain", OPTIONS)
                weight = np.concatenate([stream_weights(part.t) for part in parts])
                timed, full = (condition(chosen, samples, each) for each in (weight, None))
                found = " | ".join(evaluate_model(model, unseen) for model in (chosen, timed, full))
                what = f"{robot}, {speed:g}"
                print(f"| {what} | {rate:g} Hz, {len(samples)} | {weight.sum():.0f} | {found} |", flush=True)


if __name__ == "__main__":
    main()
