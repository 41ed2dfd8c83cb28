"""How much the training motion decides: the paper's slow stream alone against slow and fast, over several seeds."""

import numpy as np
import torch

import lipcore
from lipcore.data.metrics import evaluate
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import FAST, Stream, simulate

SEEDS, TESTS = (11, 12, 13), (2001, 2002)
TRAINING = {"slow only": (1.0,), "slow and fast": (1.0, FAST)}


def main() -> None:
    """Train on each kind of data set and each seed, print figures per joint over seeds × unseen trajectories."""
    torch.set_num_threads(1)
    robot = load_robot("panda")
    for name, speeds in TRAINING.items():
        found = {1.0: [], FAST: []}
        for seed in SEEDS:
            samples = lipcore.Samples.concatenate([simulate(robot, Stream(speed=speed), seed) for speed in speeds])
            model = lipcore.train(samples, robot.joint_types, "lip-chain")
            for speed, figures in found.items():
                for test_seed in TESTS:
                    test = simulate(robot, Stream(speed=speed, n_sinusoids=100), test_seed)
                    answer = model.predict(test.q, test.dq, test.ddq)
                    metrics = evaluate(test.tau, *answer.interval)
                    figures.append((metrics.nmse, metrics.coverage))
        for speed, figures in found.items():
            nmse, coverage = (np.array(part) for part in zip(*figures, strict=True))
            print(f"trained on {name}, tested at speed {speed:g}: per joint")
            print("  nMSE median     ", *(f"{value:8.1e}" for value in np.median(nmse, axis=0)))
            print("  nMSE worst      ", *(f"{value:8.1e}" for value in nmse.max(axis=0)))
            print("  coverage mean   ", *(f"{value:8.2f}" for value in coverage.mean(axis=0)))
            print("  coverage lowest ", *(f"{value:8.2f}" for value in coverage.min(axis=0)), flush=True)


if __name__ == "__main__":
    main()
