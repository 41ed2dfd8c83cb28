"""Observation batches of a simulated Panda that picks up a payload."""

from __future__ import annotations

from typing import Any

from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Payload, Simulation, simulate
from tests.service.data import eventually

MASS_KG = 1.5
OFFSET_M = (0.0, 0.0, 0.1)
"""Position of the payload in the frame of the last link."""
RATE, ROWS, BATCH = 100.0, 100, 25
PICKUP_S = 0.6
"""Time at which the payload is picked up."""
PUSH_ROWS = 20
"""Rows at the end of a recording with an external torque."""


def payload_batches(stream_id: str, mass: float = MASS_KG, external_torque: float = 0.0) -> list[dict[str, Any]]:
    """Return batches of a Panda that picks up a mass, kg, at PICKUP_S.

    `external_torque`, N·m, acts on the first and last joint at the end, as no payload does.
    """
    load = Payload(mass, PICKUP_S, OFFSET_M) if mass else None
    seen = simulate(
        load_robot("panda"), Simulation(n_samples=ROWS, rate=RATE, noise=0.05, speed=5.0, payload=load), seed=3
    )
    tau = seen.tau.copy()
    tau[-PUSH_ROWS:, [0, 6]] += external_torque
    parts = [slice(at, at + BATCH) for at in range(0, ROWS, BATCH)]
    values = {"t": seen.t, "q": seen.q, "dq": seen.dq, "ddq": seen.ddq, "tau": tau}
    return [
        {"stream_id": stream_id, "sequence": number, **{name: each[part].tolist() for name, each in values.items()}}
        for number, part in enumerate(parts)
    ]


def send_payload_batches(
    client: Any, model: str, stream_id: str, mass: float = MASS_KG, external_torque: float = 0.0
) -> None:
    """Send the batches of a stream and wait until its payload is detected."""
    for body in payload_batches(stream_id, mass, external_torque):
        answer = client.post(f"/v1/models/{model}/observations", json=body)
        assert answer.status_code == 200, answer.text

    def state() -> str | None:
        streams = client.get(f"/v1/models/{model}/payload").json()["streams"]
        return next((each["state"] for each in streams if each["stream_id"] == stream_id), None)

    eventually(lambda: state() != "none")
