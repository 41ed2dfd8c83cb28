"""What a served arm knows of its payload, over its users' path: batches and questions over HTTP, in turn."""

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
"""s after the payload is taken up at which the service is judged."""


@dataclass(frozen=True)
class Figure:
    """A number and its standard deviation."""

    mean: float
    std: float

    def holds(self, truth: float) -> bool:
        """Whether the 95 % interval does."""
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
    """How good torques of an unseen motion are. nmse, coverage: joint by joint; pooled: squared errors of all joints
    over the variances of all, which a joint that hardly ever bears any torque does not rule."""

    nmse: tuple[float, ...]
    coverage: tuple[float, ...]
    pooled: float

    @property
    def mean(self) -> float:
        """Mean nMSE over joints."""
        return float(np.mean(self.nmse))

    @property
    def lowest(self) -> float:
        """Coverage of the joint that has the lowest."""
        return min(self.coverage)


@dataclass
class Outcome:
    """Of one case. detected: s of event time from the pick-up to the end of the batch after which the service reports a
    payload, None for never; released: the same of putting it down; early: whether it reported one before; masses,
    answers: by s after the pick-up, None or missing where nothing is reported; before: answers to the motion with the
    payload before it is taken up; free: those to the motion without it before that, first: the first after putting it
    down; states: that the service named meanwhile;
    acks: s that batches took while something was carried.
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


def judged(exact: Samples, measured: Array, tau: Array, std: Array, noise: Array, scale: Array | float) -> Answers:
    """nMSE against the samples' torque, and coverage of the measured one."""
    nmse = evaluate(exact.tau, tau, std, noise, scale).nmse
    coverage = evaluate(measured, tau, std, noise, scale).coverage
    pooled = np.mean((exact.tau - tau) ** 2, axis=0).sum() / exact.tau.var(axis=0).sum()
    return Answers(tuple(nmse.tolist()), tuple(coverage.tolist()), float(pooled))


def asked(bed: Bed, model: str, unseen: tuple[Samples, Array]) -> Answers:
    """Ask for an unseen motion, in no stream's name, and judge what is answered."""
    exact, measured = unseen
    answer = bed.client.predict(model, exact.q, exact.dq, exact.ddq)
    tau, std, noise = (np.array(each) for each in (answer.tau, answer.tau_std, answer.noise_std))
    return judged(exact, measured, tau, std, noise, 1.0 if answer.scale is None else np.array(answer.scale))


def known(client: HttpClient, model: str) -> tuple[str, Figure | None]:
    """State and mass of the model's only stream, as the service reports them."""
    streams = msgspec.json.decode(client.ask(get(f"/v1/models/{model}/payload")), type=_Payloads).streams
    if not streams:
        return "none", None
    return streams[0].state, None if streams[0].payload is None else streams[0].payload.mass


def carried(bed: Bed, model: str, arm: Arm, case: Case) -> Outcome:
    """Stream a case to a model of its own at its own pace, each batch asked for and then observed; judge the service on
    the way."""
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
            # payloads are noticed beside the acknowledgement: what is known when the next batch comes, as from a robot
            time.sleep(max(0.0, began + now / RATE - time.monotonic()))
            if out is not None and out.detected is not None and now not in moments and now < down:
                out.acks.append(ack.seconds)  # its report takes as long as some batches: only where it is asked for
                continue
            state, mass = known(client, model)
            if now <= up:
                early = early or mass is not None
            if now < up:
                continue
            if out is None:
                out = Outcome(case, asked(bed, model, loaded), asked(bed, model, free), early=early)
            if state not in out.states:
                out.states.append(state)
            if up < now <= down and mass is not None and out.detected is None:
                out.detected = (now - up) / RATE
            if now > down and mass is None and out.released is None and out.detected is not None:
                out.released = (now - down) / RATE
            if now in moments:
                out.masses[moments[now]] = mass
                out.answers[moments[now]] = asked(bed, model, loaded)
            if now == down + BATCH:
                out.first = asked(bed, model, free)
    assert out is not None
    return out


def _question(model: str, batch: Samples) -> bytes:
    body = {name: getattr(batch, name).tolist() for name in ("q", "dq", "ddq")}
    return post(f"/v1/models/{model}/predict", msgspec.json.encode(body))
