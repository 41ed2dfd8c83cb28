"""A simulated Panda that takes up a payload, and what teaches a model with it."""

from __future__ import annotations

from typing import Any

from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Payload, Simulation, simulate
from tests.service.data import eventually

MASS = 1.5
OFFSET = (0.0, 0.0, 0.1)
"""Of the payload, kg, and its place in the frame of the last link, m."""
RATE, ROWS, BATCH = 100.0, 100, 25
TAKEN = 0.6
"""Seconds after which it is taken up."""
PUSHED = 20
"""Rows at the end of a recording in which something pushes."""


def lifting(stream_id: str, mass: float = MASS, push: float = 0.0) -> list[dict[str, Any]]:
    """Batches of a Panda like the shipped model's that takes up a mass, kg, after TAKEN; push: N·m on its first and
    last joint at the end, as no payload does."""
    load = Payload(mass, TAKEN, OFFSET) if mass else None
    seen = simulate(
        load_robot("panda"), Simulation(n_samples=ROWS, rate=RATE, noise=0.05, speed=5.0, payload=load), seed=3
    )
    tau = seen.tau.copy()
    tau[-PUSHED:, [0, 6]] += push
    parts = [slice(at, at + BATCH) for at in range(0, ROWS, BATCH)]
    values = {"t": seen.t, "q": seen.q, "dq": seen.dq, "ddq": seen.ddq, "tau": tau}
    return [
        {"stream_id": stream_id, "sequence": number, **{name: each[part].tolist() for name, each in values.items()}}
        for number, part in enumerate(parts)
    ]


def lift(client: Any, model: str, stream_id: str, mass: float = MASS, push: float = 0.0) -> None:
    """Have a stream take it up, and wait until that is noticed."""
    for body in lifting(stream_id, mass, push):
        answer = client.post(f"/v1/models/{model}/observations", json=body)
        assert answer.status_code == 200, answer.text

    def state() -> str | None:
        streams = client.get(f"/v1/models/{model}/payload").json()["streams"]
        return next((each["state"] for each in streams if each["stream_id"] == stream_id), None)

    eventually(lambda: state() != "none")
