"""A supervisor with little planes, for tests: `python -m tests.service.planes.little [KIND]`.

Each process prints its name and id when it works, and the signals that it gets. KIND: "failing" planes end before the
service has started, "quiet" ones beat only once.
"""

import os
import signal
import sys
import time

from service.planes.pulse import Plane, Pulse
from service.planes.supervisor import Child, Supervisor

KIND = sys.argv[1] if len(sys.argv) > 1 else "usual"
EXIT_CODE = 42


def say(*words: object) -> None:
    """Print a line at once."""
    os.write(1, (" ".join(map(str, words)) + "\n").encode())


def work(pulse: Pulse, plane: Plane) -> None:
    """Beat until SIGTERM."""
    name, ended = plane.name.lower(), []
    signal.signal(signal.SIGTERM, lambda *_: ended.append(1))
    signal.signal(signal.SIGUSR1, lambda *_: say(name, "told"))
    if KIND == "failing" and plane == Plane.CONTROL:
        sys.exit(EXIT_CODE)
    while KIND == "failing" and not ended:
        time.sleep(0.01)
    pulse.beat(plane)
    say(name, os.getpid())
    while not ended or KIND == "quiet":
        if KIND != "quiet":
            pulse.beat(plane)
        time.sleep(0.01)
    say(name, "ended")


def main() -> None:
    """Supervise one process of each plane."""
    pulse = Pulse()
    children = [Child(plane, lambda plane=plane: work(pulse, plane), plane.name) for plane in Plane]  # type: ignore[misc]
    ending = Supervisor(children, pulse, lambda: say("stopping")).run()
    say("ending", ending)


if __name__ == "__main__":
    main()
