"""How a model learns, its alarms and the decision about a change, as the API takes and shows them."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from service.learning.control.schema import Revised
from service.learning.learning_options import LearningOptions


class Stream(BaseModel):
    """A source of observations."""

    stream_id: str
    kind: Literal["batches", "frames"]
    last: int = Field(description="Highest sequence that has come")
    offset_s: float = Field(description="Event time (Unix seconds) - the stream's own time")
    gaps: list[list[int]] = Field(description="Ranges [first, last] of sequences that have not come, the latest ones")
    missing: int = Field(description="Sequences that have not come, of all gaps that are kept")
    forgotten: int | None = Field(description="Up to this sequence batches are no longer kept, nor known again")


class Held(BaseModel):
    """The robot seems to have changed: nothing is learnt until the owner has decided, or has chosen otherwise."""

    at: float | None = Field(description="Event time of the change, Unix seconds")
    evidence: dict[str, Any]


class Snapshot(BaseModel):
    """A revision whose state is stored."""

    revision: int
    created_at: str


class Candidate(BaseModel):
    """A refreshed version that is compared with the one that serves, on rows that neither has learnt."""

    version: int
    revision: int


class LearningStatus(BaseModel):
    """Where learning stands."""

    version: int = Field(description="The version that serves")
    revision: int = Field(description="Its revision once all of the log is learnt")
    published: int = Field(description="The revision that answers contain now")
    lag_events: int = Field(description="Events of the log that answers do not contain yet")
    events: int = Field(description="Number of the newest event of the log")
    novel_share: float | None = Field(
        description="Share of the latest samples that lie beyond the basis; null until some are learnt"
    )
    linearisation_error: list[float] | None = Field(
        None,
        description="Error of taking the torque of a learnt arm as linear around the arm as trained, root mean square "
        "of each joint in units of √(tau_std² + noise_std²); zero for a joint predicted as well as stated, null "
        "without such an arm and until something is learnt",
    )
    failure: str | None = Field(description="Why the version does not learn, where it should; it is tried again")
    held: Held | None
    candidate: Candidate | None
    streams: list[Stream]
    reachable: list[list[int]] = Field(
        description="Ranges [first, last] of revisions that a rollback can return to; 0 is the version as trained"
    )
    snapshots: list[Snapshot] = Field(description="Those whose state is stored, newest first")


class Learning(BaseModel):
    """How a model learns, as its owner has set it, and where it stands."""

    model: str
    options: LearningOptions
    status: LearningStatus


class ChangeRequest(BaseModel):
    """What to do about a change that learning is held for."""

    model_config = ConfigDict(
        extra="forbid", strict=True, json_schema_extra={"examples": [{"decision": "adapt", "replay": True}]}
    )

    decision: Literal["adapt", "ignore"] = Field(
        description="adapt: the robot has changed, what was learnt before counts less from then on; ignore: go on"
    )
    replay: bool = Field(False, description="Also learn the rows that were kept out since with the code `change`")


class Decided(Revised):
    """Learning goes on."""

    decision: Literal["adapt", "ignore"]
    at: float | None = Field(description="Event time of the change, Unix seconds")
    rows: int = Field(description="Rows that were kept out since and are learnt now")


class Alarm(BaseModel):
    """Something about a learning model that its owner should know."""

    id: int
    kind: Literal["change", "novelty", "linearisation", "refresh", "promotion"]
    at: str
    message: str
    evidence: dict[str, Any]


class AlarmPage(BaseModel):
    """One page of alarms, newest first."""

    items: list[Alarm]
    next_cursor: str | None
