"""Train the shipped model `panda-sim` on simulated streams, and print its accuracy on test trajectories."""

import shutil
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

import lipcore
from lipcore.data.metrics import evaluate
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, simulate
from service.models.evaluation import range_figures
from service.models.lineage import answer_of, figures

FOLDER = Path(__file__).parent / "panda-sim"
SPEEDS = (1.0, 2.0, 5.0, 10.0)
NOISE = 0.05
"""Noise of the torque, N·m, about that of an arm's torque sensors."""
STREAMS = [(Simulation(speed=SPEEDS[k % 4], noise=NOISE, motion="full"), 100 + k) for k in range(16)]
"""Streams over the whole range of every joint. The arm is learnt from torque alone, without the URDF."""


TEST_SEEDS = (900, 901, 902)


def judge(model: lipcore.TorqueModel) -> dict[str, Any]:
    """Return the figures of the model on streams that it has not learnt, for its verdict."""
    robot = load_robot("panda")
    streams = [Simulation(speed=speed, n_sinusoids=100, noise=NOISE, motion="full") for speed in SPEEDS]
    tests = [simulate(robot, stream, seed) for stream in streams for seed in TEST_SEEDS]
    test = lipcore.Samples.concatenate(tests)
    return {
        "torque_noise": [NOISE] * robot.n_joints,
        **range_figures(test, answer_of(model, test), model.training_range),
        **figures(model, test, len(test), len(test)),
    }


def main() -> None:
    """Simulate, train, evaluate and save."""
    threadpool_limits(1)
    robot = load_robot("panda")
    samples = lipcore.Samples.concatenate([simulate(robot, stream, seed) for stream, seed in STREAMS])

    def show(progress: lipcore.FitProgress) -> None:
        print(f"\r{progress.stage} {progress.iteration}: {progress.objective:.1f}", end="", file=sys.stderr)

    model = lipcore.train(samples, robot.joint_types, "rigid-body", on_progress=show)
    lineage = {
        "simulation": [{**asdict(stream), "robot": "panda", "seed": seed} for stream, seed in STREAMS],
        "made_by": "models/train_panda_sim.py",
        "judged": judge(model),
    }
    print(f"\nspeed  joint  {'nMSE':>9}  {'RMSE N·m':>9}  coverage of 95 %")
    for speed in SPEEDS:
        streams = [Simulation(speed=speed, n_sinusoids=100, noise=NOISE, motion="full")] * 3
        tests = [simulate(robot, stream, seed) for stream, seed in zip(streams, TEST_SEEDS, strict=True)]
        test = lipcore.Samples.concatenate(tests)
        answer = model.predict(test.q, test.dq, test.ddq)
        metrics = evaluate(test.tau, answer.tau, answer.tau_std, answer.noise_std)
        for joint in range(robot.n_joints):
            figures = metrics.nmse[joint], metrics.rmse[joint], metrics.coverage[joint]
            print(f"{speed:5g}  {joint + 1:5d}  {figures[0]:9.2e}  {figures[1]:9.4f}  {figures[2]:.3f}")
    if FOLDER.exists():
        shutil.rmtree(FOLDER)
    lipcore.save(model, FOLDER, lineage)
    print(f"noise {np.round(model.noise_std, 4)} N·m; {model.compact}; wrote {FOLDER.name}")


if __name__ == "__main__":
    main()
