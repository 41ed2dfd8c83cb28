"""False payloads on streams without payload, with and without contacts.

`PayloadTracker` runs in this process with the model as trained, without online learning.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from rich.console import Console

from benchmarks.online.arms import EDGE_S, NOISE, RATE, SPEEDS, Arm
from benchmarks.online.carried import BATCH
from benchmarks.online.scene import rows_of
from lipcore.data.samples import Array, Samples
from lipcore.model.payload import Carrier
from lipcore.model.torque_model import TorqueModel
from lipcore.online.payload.holding import PayloadTracker
from lipcore.robots.library import Robot, pinocchio
from lipcore.robots.simulation import Simulation, simulate

BLOCK_S = 300.0
"""Max length of a block; every block has another motion, a cold start and a new tracker."""
EVERY_S, CONTACT_S = 2.0, 0.2
"""Period and length of contacts."""
FORCES, REACH = (10.0, 40.0), 0.1
"""Min and max force of a contact, N; max distance of the contact from the link's joint along each axis, m."""
CONTACT_EFFECT_S = 1.0
"""A payload detected within this time of a contact's start counts as its effect."""
_PART = 700


@dataclass
class Quiet:
    """Figures of one arm in one kind of motion.

    Attributes:
        robot: name of the robot.
        kind: kind of the arm.
        speed: name of the speed.
        minutes: length of the motion.
        noticed: payloads detected without contacts.
        contacts: number of contacts.
        taken: contacts detected as a payload.
        held_s: longest time until such a payload was dropped.
        failures: numerical failures of the tracker.
    """

    robot: str
    kind: str
    speed: str
    minutes: float
    noticed: int = 0
    contacts: int = 0
    taken: int = 0
    held_s: float = 0.0
    failures: int = 0


def watched(arm: Arm, model: TorqueModel, minutes: float, console: Console) -> list[Quiet]:
    """Track `minutes` of slow and of fast motion, each without and with contacts."""
    found, carrier = [], Carrier(model)
    for speed in SPEEDS:
        total, at, block = Quiet(arm.name, arm.kind, speed, minutes), 0.0, 0
        while at < 60 * minutes:
            samples = _block(arm, min(BLOCK_S, 60 * minutes - at), SPEEDS[speed], block)
            alone, failures = payloads(carrier, samples)
            total.noticed += len(alone)
            starts = np.arange(EVERY_S, samples.t[-1] - EVERY_S, EVERY_S)
            rng = np.random.default_rng([arm.seed, block])
            touched = replace(samples, tau=samples.tau + touches(arm.robot, samples, starts, rng))
            seen, failures_touched = payloads(carrier, touched)
            taken = [held for held in (_held_seconds(seen, start) for start in starts) if held > 0]
            total.contacts += len(starts)
            total.taken += len(taken)
            total.held_s = max([total.held_s, *taken])
            total.failures += failures + failures_touched
            at, block = at + BLOCK_S, block + 1
        found.append(total)
        console.print(found[-1], highlight=False, soft_wrap=True)
    return found


def payloads(carrier: Carrier, samples: Samples) -> tuple[list[tuple[float, float]], int]:
    """Return time and duration of each detected payload, s, and the number of numerical failures."""
    failed = 0
    tracker, rows, found, since = (
        PayloadTracker(carrier.model.n_joints),
        rows_of(samples),
        list[tuple[float, float]](),
        None,
    )
    for start in range(0, len(rows), BATCH):
        batch = rows.take(slice(start, start + BATCH))
        now = float(batch.time[-1])
        try:
            tracker = tracker.step(carrier, batch)
        except np.linalg.LinAlgError:  # restart the tracker, like the service
            tracker, failed = PayloadTracker(carrier.model.n_joints), failed + 1
        if tracker.held is not None and since is None:
            since = now
        elif tracker.held is None and since is not None:
            found.append((since, now - since))
            since = None
    if since is not None:
        found.append((since, float(rows.time[-1]) - since + 1 / RATE))
    return found, failed


def touches(robot: Robot, samples: Samples, starts: Array, rng: np.random.Generator) -> Array:
    """Return the torque Jᵀ f of contacts that begin at `starts`, s, (N, n), N·m.

    Each contact is a force, constant in the world, on a point of a random link, for CONTACT_S.
    """
    pin, data, out = pinocchio(), robot.model.createData(), np.zeros_like(samples.tau)
    for start in starts:
        link, force = int(rng.integers(1, robot.model.njoints)), rng.standard_normal(3)
        force *= rng.uniform(*FORCES) / np.linalg.norm(force)
        point = rng.uniform(-REACH, REACH, 3)
        for row in np.flatnonzero((samples.t >= start) & (samples.t < start + CONTACT_S - 0.5 / RATE)):
            pin.computeJointJacobians(robot.model, data, robot.configuration(samples.q[row]))
            jacobian = pin.getJointJacobian(robot.model, data, link, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
            arm = data.oMi[link].rotation @ point
            # the velocity of the point is v + ω × arm
            out[row] = jacobian[:3].T @ force + jacobian[3:].T @ np.cross(arm, force)
    return out


def _held_seconds(found: list[tuple[float, float]], start: float) -> float:
    """Return the duration of payloads detected because of the contact that began at `start`, s."""
    return sum(held for at, held in found if 0 <= at - start < CONTACT_EFFECT_S)


def _block(arm: Arm, seconds: float, speed: float, block: int) -> Samples:
    """Return motion without payload, from a cold start."""
    dirt, edge = arm.dirt, round(EDGE_S * RATE)
    count = round(seconds * RATE) + 2 * edge
    stream = Simulation(count, RATE, speed=speed, noise=NOISE if dirt is None else 0.0, dirt=dirt)
    samples = simulate(arm.robot, stream, 1000 * arm.seed + _PART + block).rows(slice(edge, count - edge))
    return replace(samples, t=samples.t - samples.t[0])
