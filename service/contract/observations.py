"""Observation batches, their acknowledgements and errors, and the learning options."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, PlainValidator, WithJsonSchema

from lipcore.data.outliers import MAX_TORQUE
from service.contract.body import RequestBody
from service.foundation.errors import ServiceError
from service.foundation.fields import MAX_NAMES, list_of_numbers, rows_of_numbers

CONTACT_THRESHOLD = (3.0, 100.0)
"""Bounds of the contact threshold, standard deviations. Below 3, ordinary errors of a good model would be rejected.
Above 100, even torques that are not of this robot would be learnt."""
TORQUE_LIMIT = (1e-3, MAX_TORQUE)
FORGETTING_S = (1.0, 1e9)
"""Bounds of the forgetting time, s: up to thirty years."""
FRICTION_WALK_S = (10.0, 1e9)
"""Bounds of the friction walk time, s: at least ten epochs of 1 s."""
TorqueLimit = Annotated[float, Field(ge=TORQUE_LIMIT[0], le=TORQUE_LIMIT[1], allow_inf_nan=False)]


class LearningOptions(RequestBody):
    """Options of online learning."""

    model_config = ConfigDict(frozen=True)

    enabled: bool = Field(
        True, description="False pauses learning: rows are predicted, checked and logged, but not learnt"
    )
    forgetting_s: float | None = Field(
        None,
        ge=FORGETTING_S[0],
        le=FORGETTING_S[1],
        allow_inf_nan=False,
        description="Time constant of forgetting, s of event time: a sample of this age has the weight 1/e. "
        "Null: nothing is forgotten",
    )
    friction_walk_s: float | None = Field(
        None,
        ge=FRICTION_WALK_S[0],
        le=FRICTION_WALK_S[1],
        allow_inf_nan=False,
        description="Time over which friction may drift by about 30 %, s, as in an arm that warms up. Learning follows "
        "it, and masses and geometry do not become less certain. 1800 suits most arms; null: friction does not drift",
    )
    on_change: Literal["hold", "adapt", "learn"] = Field(
        "hold",
        description="Reaction if the robot has changed, or if the first second of a stream is outside the 95 % "
        "interval. `hold`: learning is paused until the owner decides; that second is not learnt. `adapt`: a new "
        "regime begins. `learn`: learning continues as before",
    )
    torque_limits: list[TorqueLimit] | None = Field(
        None,
        max_length=MAX_NAMES,
        description="Max |tau| of each joint's actuator, N·m, to reject saturated samples; null: unknown",
    )
    contact_threshold: float = Field(
        8.0,
        ge=CONTACT_THRESHOLD[0],
        le=CONTACT_THRESHOLD[1],
        allow_inf_nan=False,
        description="Predictive standard deviations, noise included, beyond which a torque counts as a contact",
    )
    adaptive_intervals: bool = Field(
        True,
        description="Adapt interval widths online, by the `scale` of responses, so that 95 % of the streams' "
        "measurements are inside. If false, the scale is 1",
    )
    payloads: bool = Field(
        True,
        description="Detect payloads that the arm picks up and puts down, and include them in predictions at once; for "
        "models with arm geometry. While a payload is carried, rows update the payload, not the arm",
    )
    auto_refresh: bool = Field(
        True, description="Retrain in the background when motion leaves the known region or the arm its linearisation"
    )
    auto_promote: bool = Field(True, description="Serve the retrained version if it predicts better")


MAX_SEQUENCE = 2**53 - 1
"""Largest integer that every JSON reader keeps exact."""
State = Literal["learnt", "unlearnt", "rolled_back"]

StreamId = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
SequenceNumber = Annotated[int, Field(strict=True, ge=0, le=MAX_SEQUENCE)]


_Numbers = list[Annotated[float | None, WithJsonSchema({"type": ["number", "null"]})]]
Matrix = Annotated[
    NDArray[np.float64],
    PlainValidator(rows_of_numbers(nullable=True), json_schema_input_type=_Numbers | list[_Numbers]),
]
"""JSON array of shape (N, n), or (n,) for one row; null for a missing number."""
Times = Annotated[
    NDArray[np.float64], PlainValidator(list_of_numbers(nullable=True), json_schema_input_type=float | _Numbers)
]
"""JSON array of shape (N,), or a number for one row."""


class ObservationRequest(RequestBody):
    """A batch of rows from one stream, in SI units. A row with null or a number that is not finite is not learnt."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "stream_id": "cell-3",
                    "sequence": 0,
                    "t": [0.0, 0.01],
                    "q": [[0.0, -0.5, 0.0, -2.0, 0.0, 1.5, 0.7], [0.001, -0.5, 0.0, -2.0, 0.0, 1.5, 0.7]],
                    "dq": [[0.1, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0], [0.1, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0]],
                    "ddq": [[0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0]],
                    "tau": [[0.0, -25.0, 0.3, 16.0, 0.5, 1.5, 0.0], [0.0, -25.0, 0.3, 16.0, 0.5, 1.5, 0.0]],
                }
            ]
        },
    )

    stream_id: StreamId = Field(description="Stream: the robot or recording that the rows come from")
    sequence: SequenceNumber = Field(
        description="Number of the batch in its stream, counted up by one. It identifies the batch: a batch that is "
        "sent again is acknowledged again and learnt once"
    )
    t: Times | None = Field(
        None, description="Times of the rows by the stream's own clock, s: (N). By default the time of arrival"
    )
    q: Matrix = Field(description="Positions, rad (prismatic: m): (N, n), or (n) for one row")
    dq: Matrix = Field(description="Velocities, rad/s (m/s)")
    ddq: Matrix | None = Field(
        None, description="Accelerations, rad/s² (m/s²); if absent, they are derived from `t` and `dq`, with a delay"
    )
    tau: Matrix = Field(description="Measured torques, N·m (prismatic: N), in the model's torque convention")
    joint_names: list[str] | None = Field(
        None, max_length=1000, description="Joints in the order of the columns; by default the model's order"
    )


class DerivedAcceleration(BaseModel):
    """Derivation of accelerations: the slope of a parabola through the velocities around each row."""

    delay_s: float = Field(description="Delay from a row to its acceleration, s")
    window: int = Field(description="Rows used on either side of a row")
    rate_hz: float = Field(description="Sampling rate of the rows, Hz")
    carried: int = Field(
        description="Rows of neighbouring batches that had to wait for this one and are counted with it"
    )


class Derivation(BaseModel):
    """Derived quantities."""

    ddq: DerivedAcceleration


class ObservationResponse(BaseModel):
    """Acknowledgement: the rows are logged durably, and `accepted` of them are learnt soon."""

    model: str
    version: int = Field(description="Version that predicted the rows before it learnt them")
    revision: int = Field(description="Responses of this version with this `revision` or a later one contain the batch")
    stream_id: str
    sequence: int
    rows: int = Field(description="Rows received")
    accepted: int = Field(description="Rows that are learnt")
    effective_samples: float | None = Field(
        None,
        description="Effective samples of the accepted rows: neighbouring rows of a fast stream are correlated, and "
        "with `forgetting_s` late rows count less. Null for a batch logged by an earlier release",
    )
    duplicate: bool = Field(description="Whether the batch was received before; then this is its first acknowledgement")
    state: State = Field(description="Present state of the batch")
    rejected: dict[str, int] = Field(
        description="Rows that are stored but not learnt, by code: `non_finite`, `limit`, `time_jump`, `saturation`, "
        "`stationary`, `contact`, `change` (the robot changed or the stream does not fit, and the owner has not "
        "decided yet), `payload` (the arm carries a payload, which the row updates instead), `edge` (acceleration "
        "cannot be derived yet; if the stream continues, these are learnt with the next batch), `late` (so late that "
        "with `forgetting_s` it counts less than 0.001), `paused` (learning is paused), `implausible` (not a measured "
        "torque: zero against gravity, the model's own prediction, or constant while the arm moves)"
    )
    gaps: list[list[int]] = Field(description="Latest ranges [first, last] of missing sequences of the stream")
    derived: Derivation | None = Field(None, description="Derived quantities; null if all were sent")
    held: bool = Field(description="Whether learning is paused until the model's owner decides about a change")


class ExpiredError(ServiceError):
    """The batch is so old that the service cannot tell whether it was learnt."""

    status, code = 409, "expired"
