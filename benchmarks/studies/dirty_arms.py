"""Coverage of the 95 % interval on simulated arms with `Dirt`, on three kinds of motion.

    python benchmarks/studies/dirty_arms.py ESTIMATOR SEEDS [ROBOT...]

Every arm is trained on 10 s and on 60 s of random sinusoids at 100 Hz, prepared like recordings (4 Hz low-pass without
delay). It is tested on at least MIN_TEST_S of other motion of the same kind, of motion three times as fast, and of
moves with rests, about as fast as in training. Friction follows the motion.

Coverage is the mean over the seeds; `lowest` is that of one seed and joint. `width` is the width of the interval over
the central 95 % of a Gaussian with the standard deviation of the errors, the median over seeds and joints. A cell is a
joint of an arm.
"""

import sys
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

import lipcore
from lipcore.data.metrics import LEVEL, evaluate, quantile
from lipcore.data.samples import Samples
from lipcore.data.signals import differentiate, low_pass
from lipcore.robots.dirt import Dirt
from lipcore.robots.library import Robot, load_robot
from lipcore.robots.simulation import Simulation, simulate

ARMS = ("panda", "ur5", "ur10", "kinova", "xarm7", "z1", "tiago", "baxter-left")
RATE, SPEED, SECONDS, KEEP = 100.0, 5.0, (10, 60), 5
MIN_TEST_S, RESTS_S = 20.0, 40.0
CASES = ("same", "three times faster", "rests")


def recording(seconds: float, dirt: Dirt) -> Simulation:
    """Return the training stream of an arm."""
    return Simulation(round(seconds * RATE), RATE, speed=SPEED, noise=0.0, dirt=dirt)


def unseen(robot: Robot, stream: Simulation, case: str, seed: int) -> Samples:
    """Return test recordings of an arm that was trained on `stream`, in motion of one of CASES."""
    if case == "three times faster":
        stream = replace(stream, n_samples=round(stream.n_samples / 3), speed=3 * SPEED)
    elif case == "rests":
        stream = replace(stream, n_samples=round(RESTS_S * RATE), course="rests", speed=0.5)
    count = int(np.ceil(MIN_TEST_S / (stream.n_samples / RATE)))
    return Samples.concatenate([recorded(robot, stream, 200 + 1000 * k + seed) for k in range(count)])


def recorded(robot: Robot, stream: Simulation, seed: int) -> Samples:
    """Return a simulated recording, prepared if it has dirt, of the same rate in any case."""
    samples = simulate(robot, stream, seed)
    return samples.rows(slice(None, None, KEEP)) if stream.dirt is None else prepared(samples)


def prepared(samples: Samples) -> Samples:
    """Filter samples like a recording, derive acceleration from velocity, and keep every fifth row."""
    q, dq, tau = (low_pass(signal, RATE) for signal in (samples.q, samples.dq, samples.tau))
    return replace(samples, q=q, dq=dq, ddq=differentiate(dq, RATE), tau=tau).rows(slice(None, None, KEEP))


def main() -> None:
    """Print a Markdown table with a row for each arm, duration and case, then a summary."""
    threadpool_limits(1)
    estimator, seeds, names = sys.argv[1], int(sys.argv[2]), sys.argv[3:] or ARMS
    print("| arm | s | unseen motion | coverage, joint by joint, % | lowest | width |\n|" + " --- |" * 6)
    every: dict[tuple[int, str], list[np.ndarray]] = {(seconds, case): [] for seconds in SECONDS for case in CASES}
    for name in names:
        robot = load_robot(name)
        for seconds in SECONDS:
            cells: dict[str, list[np.ndarray]] = {case: [] for case in CASES}
            for seed in range(seeds):
                dirt = Dirt(seed=seed)  # of one arm
                known = recorded(robot, recording(seconds, dirt), 100 + seed)
                model = lipcore.train(known, robot.joint_types, estimator)
                for case in CASES:
                    held = unseen(robot, recording(seconds, dirt), case, seed)
                    answer = model.predict_along(held)
                    metrics = evaluate(held.tau, *answer.interval)
                    oracle = 2 * quantile(LEVEL) * (held.tau - answer.tau).std(0)
                    cells[case].append(np.array([metrics.coverage, metrics.width / oracle]))
            for case, pairs in cells.items():
                coverage, width = np.array(pairs).swapaxes(0, 1)
                every[seconds, case].append(np.array([coverage.mean(0), width.mean(0)]))
                shown = " ".join(f"{100 * each:.0f}" for each in coverage.mean(0))
                lowest = f"{100 * coverage.min():.0f} | {np.median(width):.2f}"
                print(f"| {name} | {seconds} | {case} | {shown} | {lowest} |", flush=True)
    for (seconds, case), rows in every.items():
        coverage, width = np.concatenate(rows, axis=1)
        print(
            f"{seconds} s, {case}: {coverage.size} cells, mean coverage {100 * coverage.mean():.1f} %, "
            f"{(coverage < 0.85).sum()} below 85 %; median width {np.median(width):.2f}, {(width > 2).sum()} above 2"
        )


if __name__ == "__main__":
    main()
