"""Payload estimates and torques of a served arm that gets observation batches and queries over HTTP."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import msgspec
import numpy as np

from benchmarks.clients import HttpClient, get, post
from benchmarks.online.arms import DOWN, RATE, SECONDS, UP, Arm, Case
from benchmarks.online.bed import Bed
from benchmarks.online.sending import batch_request, send
from lipcore.data.metrics import evaluate, quantile
from lipcore.data.samples import Array, Samples

BATCH, STREAM = 10, "arm"
AFTER = (0.1, 0.5, 1.0, 3.0)
"""Times after the pick-up at which the service is evaluated, s."""


@dataclass(frozen=True)
class Figure:
    """An estimate and its standard deviation."""

    mean: float
    std: float

    def contains(self, truth: float) -> bool:
        """Return whether the 95 % interval contains the truth."""
        return abs(self.mean - truth) <= quantile(0.95) * self.std


@dataclass(frozen=True)
class _Body:
    mass: Figure


@dataclass(frozen=True)
class _Stream:
    state: str
    payload: _Body | None


@dataclass(frozen=True)
class _Payloads:
    streams: list[_Stream]


@dataclass(frozen=True)
class Answers:
    """Accuracy of torques on a test motion.

    Attributes:
        nmse: nMSE of each joint.
        coverage: coverage of each joint.
        pooled: squared errors of all joints over the variances of all; a joint with little torque hardly counts.
    """

    nmse: tuple[float, ...]
    coverage: tuple[float, ...]
    pooled: float

    @property
    def mean(self) -> float:
        """Mean nMSE over joints."""
        return float(np.mean(self.nmse))

    @property
    def lowest(self) -> float:
        """Lowest coverage of a joint."""
        return min(self.coverage)


@dataclass
class Outcome:
    """Figures of one case.

    Attributes:
        case: the case.
        before: answers, before the pick-up, to the motion with payload.
        free: answers, before the pick-up, to the motion without payload.
        detected: stream time from the pick-up to the end of the batch that revealed the payload, s; None: never.
        released: the same after the release.
        early: whether a payload was reported before the pick-up.
        masses: reported mass by s after the pick-up; None: nothing was reported.
        answers: answers to the motion with payload, by s after the pick-up.
        first: first answers after the release to the motion without payload.
        states: all states that the service reported.
        acks: times to acknowledgement while the payload is carried, s.
    """

    case: Case
    before: Answers
    free: Answers
    detected: float | None = None
    released: float | None = None
    early: bool = False
    masses: dict[float, Figure | None] = field(default_factory=dict)
    answers: dict[float, Answers] = field(default_factory=dict)
    first: Answers | None = None
    states: list[str] = field(default_factory=list)
    acks: list[float] = field(default_factory=list)


def evaluate_answers(
    exact: Samples, measured: Array, tau: Array, std: Array, noise: Array, scale: Array | float
) -> Answers:
    """Return nMSE against the samples' torque, and coverage of the measured torque."""
    nmse = evaluate(exact.tau, tau, std, noise, scale).nmse
    coverage = evaluate(measured, tau, std, noise, scale).coverage
    pooled = np.mean((exact.tau - tau) ** 2, axis=0).sum() / exact.tau.var(axis=0).sum()
    return Answers(tuple(nmse.tolist()), tuple(coverage.tolist()), float(pooled))


def evaluate_served(bed: Bed, model: str, unseen: tuple[Samples, Array]) -> Answers:
    """Evaluate the default model on a test motion."""
    exact, measured = unseen
    answer = bed.client.predict(model, exact.q, exact.dq, exact.ddq)
    tau, std, noise = (np.array(each) for each in (answer.tau, answer.tau_std, answer.noise_std))
    return evaluate_answers(exact, measured, tau, std, noise, 1.0 if answer.scale is None else np.array(answer.scale))


def read_payload(client: HttpClient, model: str) -> tuple[str, Figure | None]:
    """Return the reported state and mass of the model's only stream."""
    streams = msgspec.json.decode(client.ask(get(f"/v1/models/{model}/payload")), type=_Payloads).streams
    if not streams:
        return "none", None
    return streams[0].state, None if streams[0].payload is None else streams[0].payload.mass


def stream_case(bed: Bed, model: str, arm: Arm, case: Case) -> Outcome:
    """Stream a case to a model in real time, with a query before each batch, and evaluate the service."""
    samples = arm.live(case)
    loaded, free = (arm.unseen(case, carries) for carries in (True, False))
    moments = {round((UP + after) * RATE): after for after in AFTER}
    up, down, end = (round(at * RATE) for at in (UP, DOWN, SECONDS))
    out, early = None, False
    began = time.monotonic()
    with HttpClient(bed.tcp) as client:
        for number, start in enumerate(range(0, end, BATCH)):
            batch, now = samples.rows(slice(start, start + BATCH)), start + BATCH
            client.ask(_question(model, batch))
            ack = send(client, batch_request(model, STREAM, number, batch))
            # payloads are detected after the acknowledgement: read the estimate when a robot sends the next batch
            time.sleep(max(0.0, began + now / RATE - time.monotonic()))
            if out is not None and out.detected is not None and now not in moments and now < down:
                out.acks.append(ack.seconds)  # reading the estimate takes as long as some batches: skip it
                continue
            state, mass = read_payload(client, model)
            if now <= up:
                early = early or mass is not None
            if now < up:
                continue
            if out is None:
                out = Outcome(case, evaluate_served(bed, model, loaded), evaluate_served(bed, model, free), early=early)
            if state not in out.states:
                out.states.append(state)
            if up < now <= down and mass is not None and out.detected is None:
                out.detected = (now - up) / RATE
            if now > down and mass is None and out.released is None and out.detected is not None:
                out.released = (now - down) / RATE
            if now in moments:
                out.masses[moments[now]] = mass
                out.answers[moments[now]] = evaluate_served(bed, model, loaded)
            if now == down + BATCH:
                out.first = evaluate_served(bed, model, free)
    assert out is not None
    return out


def _question(model: str, batch: Samples) -> bytes:
    body = {name: getattr(batch, name).tolist() for name in ("q", "dq", "ddq")}
    return post(f"/v1/models/{model}/predict", msgspec.json.encode(body))
