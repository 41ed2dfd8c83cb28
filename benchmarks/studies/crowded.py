"""Time to the acknowledgement of one model's batches while another model's streams change their payload all the time.

    python benchmarks/studies/crowded.py [STREAMS]

A service has two copies of the shipped Panda. The first gets ten batches of ten rows a second: for 10 s alone, then for
12 s while STREAMS (8) simulated robots send as much to the second. Each of these carries 1.5 kg in two of every four
seconds.
"""

from __future__ import annotations

import sys
import tempfile
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np

import lipcore
from benchmarks.clients import HttpClient
from benchmarks.online.bed import Bed, install, serving
from benchmarks.online.sending import Ack, batch_requests, stream
from lipcore.data.samples import Samples
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Payload, Simulation, simulate
from service.contract.observations import LearningOptions

CROWDED, OTHER = "crowded", "other"
ROWS, PERIOD_S, ALONE_S, BESIDE_S, LEAD_S = 10, 0.1, 10, 12, 2.0
CYCLE_S = 4.0
MOTION = Simulation(int(100 * (ALONE_S + BESIDE_S)), 100.0, speed=5.0, noise=0.05)


def carrying(seed: int) -> Samples:
    """Return samples of a Panda that carries a payload in the second half of each cycle."""
    robot = load_robot("panda")
    free, full = (simulate(robot, each, seed) for each in (MOTION, replace(MOTION, payload=Payload(1.5, 0.0))))
    held = (free.t % CYCLE_S >= CYCLE_S / 2)[:, None]
    return replace(free, tau=np.where(held, full.tau, free.tau))


def send(bed: Bed, requests: list[bytes], acks: list[Ack]) -> None:
    """Send batches in real time."""
    with HttpClient(bed.tcp) as client:
        acks += stream(client, requests, PERIOD_S)


def print_times(what: str, acks: list[Ack]) -> None:
    """Print the time to acknowledgement."""
    p50, p99, longest = (1e3 * np.quantile([ack.seconds for ack in acks], share) for share in (0.5, 0.99, 1.0))
    print(f"{what:24} {len(acks):5} batches, ms: p50 {p50:6.1f}  p99 {p99:6.1f}  largest {longest:6.1f}")


def main(streams: int) -> None:
    """Measure and print."""
    folder = Path(__file__).parents[2] / "models" / "panda-sim"
    own = batch_requests(OTHER, "own", simulate(load_robot("panda"), MOTION, 99), rows=ROWS)
    crowd = [batch_requests(CROWDED, f"robot-{seed}", carrying(seed), rows=ROWS) for seed in range(streams)]
    alone, beside = round(ALONE_S / PERIOD_S), round((BESIDE_S + LEAD_S) / PERIOD_S)
    with tempfile.TemporaryDirectory() as made:
        home, joints = Path(made) / "home", lipcore.load(folder).n_joints
        install(home, folder, dict.fromkeys((CROWDED, OTHER), LearningOptions(auto_refresh=False)), joints)
        with serving(home) as bed:
            acks: list[list[Ack]] = [[] for _ in crowd]
            idle: list[Ack] = []
            busy: list[Ack] = []
            send(bed, own[:alone], idle)
            threads = [
                threading.Thread(target=send, args=(bed, requests[:beside], into))
                for requests, into in zip(crowd, acks, strict=True)
            ]
            for thread in threads:
                thread.start()
            send(bed, own[alone:], busy)
            for thread in threads:
                thread.join()
    print_times("first model, alone", idle)
    print_times("first model, loaded", busy)
    print_times(f"the {streams} streams", [ack for each in acks for ack in each])


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 8)
