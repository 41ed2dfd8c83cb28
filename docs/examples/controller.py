"""A 500 Hz torque loop: it uses a learnt model if the answer is in time and certain enough, else its own torque.

    python docs/examples/controller.py panda-sim

Replace `FakeRobot` by your robot. Nothing here protects your hardware from a wrong torque: keep the limits and the
emergency stop of your controller.
"""

from __future__ import annotations

import sys
import time
from collections import Counter

import numpy as np

from lipserve import Client, StreamClient, StreamError

PERIOD_S = 0.002
BUDGET_S = 0.001  # wait for an answer at most so long in each cycle
MAX_STD = 1.0  # N·m: answers with a larger tau_std are not used; choose it joint by joint for your robot


class FakeRobot:
    """A robot that moves on sinusoids, has no torque of its own and ignores commands."""

    def __init__(self, joints: int) -> None:
        self.joints, self.began = joints, time.perf_counter()

    def desired(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the desired position, velocity and acceleration, (n,) each."""
        phase = (time.perf_counter() - self.began) * np.linspace(0.5, 1.5, self.joints)
        return 0.3 * np.sin(phase), 0.3 * np.cos(phase), -0.3 * np.sin(phase)

    def own_torque(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
        """Return the torque of the controller's own model, the fallback."""
        return np.zeros(self.joints)

    def command(self, tau: np.ndarray) -> None:
        """Send torques to the drives."""


def run(stream: StreamClient, robot: FakeRobot, cycles: int) -> Counter[str]:
    """Run some cycles; return how often the answer was used, and how often it was not, by reason."""
    seen: Counter[str] = Counter()
    stream.timeout = PERIOD_S / 2  # the loop never waits longer
    due = time.perf_counter()
    for _ in range(cycles):
        q, dq, ddq = robot.desired()
        tau = robot.own_torque(q, dq, ddq)
        try:
            answer = stream.predict(q, dq, ddq, deadline=BUDGET_S)
        except StreamError as error:  # no answer in time, a rejected motion, or no service
            why = error.code
        else:
            why = "late" if answer.late else "uncertain" if (answer.tau_std > MAX_STD).any() else "used"
            tau = answer.tau if why == "used" else tau
        robot.command(tau)
        seen[why] += 1
        now = time.perf_counter()
        due = max(due + PERIOD_S, now)  # do not make up for a long cycle
        time.sleep(due - now)
    return seen


if __name__ == "__main__":
    with Client() as client, client.stream(sys.argv[1]) as opened:
        print(dict(run(opened, FakeRobot(len(opened.hello.joint_names)), cycles=2500)))
