"""A torque loop of 500 Hz that uses a learnt model where that can be trusted, and its own torque where it cannot.

    python docs/examples/controller.py panda-sim

Put your robot in the place of `Rehearsal`. Nothing here stands between a wrong torque and your hardware: keep the
limits and the emergency stop of your controller.
"""

from __future__ import annotations

import sys
import time
from collections import Counter

import numpy as np

from lipserve import Client, StreamClient, StreamError

PERIOD_S = 0.002
BUDGET_S = 0.001  # of a cycle for the answer: what comes later is no use to this cycle
MOST_STD = 1.0  # N·m: a torque that the model knows less well is not used; choose it joint by joint for your robot


class Rehearsal:
    """Stands in for a robot: it moves on sinusoids, its own torque is zero, and what is commanded is dropped."""

    def __init__(self, joints: int) -> None:
        self.joints, self.began = joints, time.perf_counter()

    def desired(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position, velocity and acceleration that the trajectory asks for now, (n,) each."""
        phase = (time.perf_counter() - self.began) * np.linspace(0.5, 1.5, self.joints)
        return 0.3 * np.sin(phase), 0.3 * np.cos(phase), -0.3 * np.sin(phase)

    def own_torque(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
        """The torque of the controller's own model, which it falls back on."""
        return np.zeros(self.joints)

    def command(self, tau: np.ndarray) -> None:
        """Send torques to the drives."""


def run(stream: StreamClient, robot: Rehearsal, cycles: int) -> Counter[str]:
    """Control for so many cycles; return how often the answer was used, and why it was not."""
    seen: Counter[str] = Counter()
    stream.timeout = PERIOD_S / 2  # a loop never waits for longer, whatever becomes of the service
    due = time.perf_counter()
    for _ in range(cycles):
        q, dq, ddq = robot.desired()
        tau = robot.own_torque(q, dq, ddq)
        try:
            answer = stream.predict(q, dq, ddq, deadline=BUDGET_S)
        except StreamError as error:  # no answer in time, a motion that is refused, or the service is gone: go on
            why = error.code
        else:
            why = "late" if answer.late else "uncertain" if (answer.tau_std > MOST_STD).any() else "used"
            tau = answer.tau if why == "used" else tau
        robot.command(tau)
        seen[why] += 1
        now = time.perf_counter()
        due = max(due + PERIOD_S, now)  # a cycle that took too long is not made up for
        time.sleep(due - now)
    return seen


if __name__ == "__main__":
    with Client() as client, client.stream(sys.argv[1]) as opened:
        print(dict(run(opened, Rehearsal(len(opened.hello.joint_names)), cycles=2500)))
