"""How good `rigid-body` is with a URDF whose masses are wrong: expecting the URDF's parameters, and expecting none.

The arm's links weigh 0.7 to 1.4 times what the URDF says, each its own; 5 training × 4 unseen test streams a speed, as
in `python -m benchmarks.reproduce`. nMSE is against the torque without noise, coverage of the 95 % interval that of
measurements.
"""

import numpy as np
from calibration import randomised
from threadpoolctl import threadpool_limits

import lipcore
from lipcore.data.metrics import evaluate
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import FAST_SPEED, Simulation, inverse_dynamics, simulate
from lipcore.robots.urdf import RigidBody

SEEDS, TESTS, STRIDE = range(1, 6), range(1001, 1005), 5


def main() -> None:
    """Print median nMSE and mean coverage per joint for both priors and both speeds."""
    threadpool_limits(1)
    nominal = load_robot("panda")
    bodies = RigidBody.from_profile("panda", nominal.joint_names, nominal.joint_types)
    for speed in (1.0, FAST_SPEED):
        for prior in ("urdf", "zero"):
            nmse, coverage = [], []
            for seed in SEEDS:
                robot, options = randomised(nominal, seed, 0.7, 1.4), lipcore.FitOptions(prior=prior)
                samples = simulate(robot, Simulation(speed=speed), seed)
                model = lipcore.train(samples, robot.joint_types, "rigid-body", options, robot=bodies)
                for test_seed in TESTS:
                    test = simulate(robot, Simulation(speed=speed, n_sinusoids=100), test_seed).rows(
                        slice(0, None, STRIDE)
                    )
                    answer = model.predict(test.q, test.dq, test.ddq)
                    truth = inverse_dynamics(robot, test.q, test.dq, test.ddq)
                    nmse.append(evaluate(truth, *answer.interval).nmse)
                    coverage.append(evaluate(test.tau, *answer.interval).coverage)
            print(f"speed {speed:g}, prior {prior}")
            print("  nMSE median  ", *(f"{value:8.1e}" for value in np.median(nmse, axis=0)))
            print("  coverage mean", *(f"{value:8.3f}" for value in np.mean(coverage, axis=0)), flush=True)


if __name__ == "__main__":
    main()
