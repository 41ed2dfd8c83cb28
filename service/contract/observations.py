"""Observations as the API takes, acknowledges and refuses them, and the options of learning."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, PlainValidator, ValidationInfo, WithJsonSchema

from lipcore.data.outliers import MAX_TORQUE
from service.foundation.errors import ServiceError
from service.foundation.fields import MAX_NAMES, numbers, rows_of_numbers

CONTACT_THRESHOLD = (3.0, 100.0)
"""Bounds of the gate of contacts. Within three standard deviations lie the errors of an honest model, so that the gate
would choose what is learnt; beyond a hundred nothing is gated: what would be learnt is no torque of this robot."""
TORQUE_LIMIT = (1e-3, MAX_TORQUE)
FORGETTING_S = (1.0, 1e9)
"""Up to thirty years: a longer memory is none that forgets."""
FRICTION_WALK_S = (10.0, 1e9)
"""From ten epochs of a second each."""
TorqueLimit = Annotated[float, Field(ge=TORQUE_LIMIT[0], le=TORQUE_LIMIT[1], allow_inf_nan=False)]


class LearningOptions(BaseModel):
    """How a model learns from observations."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    enabled: bool = Field(
        True, description="False: learning is paused. Rows are judged, compared and logged, but not learnt"
    )
    forgetting_s: float | None = Field(
        None,
        ge=FORGETTING_S[0],
        le=FORGETTING_S[1],
        allow_inf_nan=False,
        description="Age in s at which a sample counts 1/e of a new one, in event time; null: nothing is forgotten",
    )
    friction_walk_s: float | None = Field(
        None,
        ge=FRICTION_WALK_S[0],
        le=FRICTION_WALK_S[1],
        allow_inf_nan=False,
        description="Time in s over which friction may change by about 30 %, as that of an arm that warms up does: it "
        "is followed, and masses and geometry are not opened. 1800 suits most arms; null: friction stays as learnt",
    )
    on_change: Literal["hold", "adapt", "learn"] = Field(
        "hold",
        description="What follows a detected change of the robot, or a stream whose first second lies outside the 95 % "
        "band. `hold`: nothing is learnt until its owner decides, nor of that second; `adapt`: a new regime begins; "
        "`learn`: learning goes on as before",
    )
    torque_limits: list[TorqueLimit] | None = Field(
        None,
        max_length=MAX_NAMES,
        description="Largest |tau| of each joint's actuator in N·m, to tell saturated samples; null: not known",
    )
    contact_threshold: float = Field(
        8.0,
        ge=CONTACT_THRESHOLD[0],
        le=CONTACT_THRESHOLD[1],
        allow_inf_nan=False,
        description="Predictive standard deviations, noise included, beyond which a torque is taken for a contact",
    )
    adaptive_intervals: bool = Field(
        True,
        description="Widen and narrow intervals at once, so that 95 % of what streams measure lies inside: the `scale` "
        "of answers. Otherwise it is 1, as the model itself believes",
    )
    payloads: bool = Field(
        True,
        description="Notice what the arm takes up and puts down, and answer with it at once; for models that know the "
        "arm. Meanwhile rows teach the payload, and not the arm",
    )
    auto_refresh: bool = Field(True, description="Train a new version by itself where motion leaves what is known")
    auto_promote: bool = Field(True, description="Let such a version serve if it predicts better")


MOST_SEQUENCE = 2**53 - 1
"""The largest whole number that every JSON reader takes for what it is."""
State = Literal["learnt", "unlearnt", "rolled_back"]

StreamId = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
SequenceNumber = Annotated[int, Field(strict=True, ge=0, le=MOST_SEQUENCE)]


def _to_times(value: Any, info: ValidationInfo) -> NDArray[np.float64]:
    """One number or numbers (N,) as an array (N,), null as NaN; raise InvalidRequestError naming what is wrong."""
    return np.array(numbers(info.field_name or "value", value if isinstance(value, list) else [value], nullable=True))


_Numbers = list[Annotated[float | None, WithJsonSchema({"type": ["number", "null"]})]]
Matrix = Annotated[
    NDArray[np.float64],
    PlainValidator(rows_of_numbers(nullable=True), json_schema_input_type=_Numbers | list[_Numbers]),
]
"""JSON array of shape (N, n), or (n,) for one row; null where there is no number."""
Times = Annotated[NDArray[np.float64], PlainValidator(_to_times, json_schema_input_type=float | _Numbers)]
"""JSON array of shape (N,), or a number for one row."""


class ObservationRequest(BaseModel):
    """A batch of rows from one source, in SI units. A row with null or a number that is not finite is not learnt."""

    model_config = ConfigDict(
        extra="forbid",
        strict=True,
        arbitrary_types_allowed=True,
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

    stream_id: StreamId = Field(description="The robot or recording that the rows come from")
    sequence: SequenceNumber = Field(
        description="Number of the batch in its stream, counted up by one. With `stream_id` it is its identity: sent "
        "again, it is acknowledged again and learnt once"
    )
    t: Times | None = Field(
        None, description="Times of the rows by the stream's own clock, s: (N). Without them rows count as of arrival"
    )
    q: Matrix = Field(description="Positions, rad (prismatic: m): (N, n), or (n) for one row")
    dq: Matrix = Field(description="Velocities, rad/s (m/s)")
    ddq: Matrix | None = Field(
        None, description="Accelerations, rad/s² (m/s²); left out, they are derived from `t` and `dq`, with a delay"
    )
    tau: Matrix = Field(description="Measured torques, N·m (prismatic: N), of the model's convention")
    joint_names: list[str] | None = Field(
        None, max_length=1000, description="Joints in the order of the columns; that of the model by default"
    )


class DerivedAcceleration(BaseModel):
    """How accelerations were derived: as the slope of a parabola through the velocities around a row."""

    delay_s: float = Field(description="How much later than its row an acceleration is known, s")
    window: int = Field(description="Rows on either side of a row that its acceleration stands on")
    rate_hz: float = Field(description="Rows a second")
    carried: int = Field(
        description="Rows of the batches next to this one that had to wait for it, decided and counted with it"
    )


class Derivation(BaseModel):
    """What was not measured."""

    ddq: DerivedAcceleration


class ObservationResponse(BaseModel):
    """The rows are logged for good: `accepted` of them are learnt within a moment."""

    model: str
    version: int = Field(description="The version that predicted the rows before it learnt them")
    revision: int = Field(description="Answers of this version with this `revision` or a later one contain the batch")
    stream_id: str
    sequence: int
    rows: int = Field(description="Rows that came")
    accepted: int = Field(description="Rows to be learnt")
    effective_samples: float | None = Field(
        None,
        description="Independent samples that these count as now: rows of a fast stream tell nearly the same, and with "
        "`forgetting_s` late rows count less; null for a batch that an earlier release has logged",
    )
    duplicate: bool = Field(description="Whether the batch had come before: then this is what was said the first time")
    state: State = Field(description="What has become of the batch since")
    rejected: dict[str, int] = Field(
        description="Rows that are kept but not learnt, by code: `non_finite`, `limit`, `time_jump`, `saturation`, "
        "`stationary`, `contact`, `change` (a changed robot, or a stream that did not fit, and its owner has not "
        "decided), `payload` (the arm carries something, of which the row teaches instead), `edge` (acceleration not "
        "derivable; where the stream goes on, these are learnt with the next batch), `late` (came so late that by "
        "`forgetting_s` it counts less than a thousandth), `paused` (learning is paused), "
        "`implausible` (a torque that nobody has measured: zero against gravity, the model's own answer, or the same "
        "all the time while the arm moves)"
    )
    gaps: list[list[int]] = Field(
        description="Ranges [first, last] of sequences of the stream that have not come, the latest ones"
    )
    derived: Derivation | None = Field(None, description="What was derived because it was not sent")
    held: bool = Field(description="Whether learning stands still until the model's owner has decided about a change")


class ExpiredError(ServiceError):
    """The batch is so old that it is not known any more whether it has been learnt."""

    status, code = 409, "expired"
