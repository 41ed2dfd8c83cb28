"""What a transaction tells the services that share the database: of which model it has changed what.

PostgreSQL sends notices with the commit (`NOTIFY`): who hears one can read what it says, and of what was rolled back
nobody hears. Who was not connected then has missed it, and looks for itself.
"""

from __future__ import annotations

from itertools import chain
from typing import Any, Literal, NamedTuple

from sqlalchemy import text
from sqlalchemy.orm import Session

from service.storage.database.tables import (
    AliasRow,
    Base,
    DeletedModelRow,
    EventRow,
    LearnerRow,
    ServingRow,
    VersionRow,
)

CHANNEL = "lipserve"
Kind = Literal["log", "model"]
KINDS: dict[type[Base], Kind] = {
    EventRow: "log",
    VersionRow: "model",
    ServingRow: "model",
    AliasRow: "model",
    LearnerRow: "model",
    DeletedModelRow: "model",
}
_KEY = "notices"


class Notice(NamedTuple):
    """kind: `log` of a model that has grown, `model` whose versions, aliases or roles have changed or that is gone;
    origin: who has changed it."""

    kind: Kind
    model: str
    origin: str

    def payload(self) -> str:
        """What is sent; `read` is its inverse."""
        return f"{self.kind} {self.origin} {self.model}"


def read(payload: str) -> Notice | None:
    """A notice that was sent; None for what is none of this release."""
    kind, _, rest = payload.partition(" ")
    origin, _, model = rest.partition(" ")
    if kind == "log":
        return Notice("log", model, origin)
    return Notice("model", model, origin) if kind == "model" else None


def collect(session: Session, _: Any) -> None:
    """Note what is written to a session; to be called after each flush of it.

    Rows that are changed by a statement alone pass unseen: each such change comes with a row that does not.
    """
    found = session.info.setdefault(_KEY, set())
    row: Any
    for row in chain(session.new, session.dirty, session.deleted):
        if type(row) in KINDS:
            model = row.name if isinstance(row, DeletedModelRow) else row.model
            found.add((KINDS[type(row)], model))


def send(session: Session, origin: str) -> None:
    """Tell with the commit of a session what it has changed."""
    session.flush()
    for kind, model in sorted(session.info.pop(_KEY, ())):
        payload = Notice(kind, model, origin).payload()
        session.execute(text("SELECT pg_notify(:channel, :payload)"), {"channel": CHANNEL, "payload": payload})
