"""Whether a home that is left after a power cut holds what clients were told, and nothing half."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import func, select
from sqlalchemy.orm import Session, undefer

from lipcore.online.learner import OnlineModel
from service.cli.verify import verify_home
from service.foundation.settings import Settings
from service.journal import log, snapshots
from service.learning.learner.follower import Follower
from service.models import registry
from service.storage.database import (
    AliasRow,
    ApiKeyRow,
    Database,
    DatasetRow,
    EventRow,
    JobRow,
    LearningRow,
    RobotRow,
    VersionRow,
)
from service.storage.files import Files
from service.storage.files.store import start_sweeping, sweep_unnamed
from service.storage.storage import check_home
from tests.service.faults.ledger import CLOSE, names, rows
from tests.service.power.story import ANY, digest

FOLDERS = {
    "datasets": "SELECT id || '.safetensors' FROM datasets",
    "versions": "SELECT folder FROM versions",
    "learning": "SELECT id || '.safetensors' FROM snapshots",
    "uploads": "SELECT id FROM datasets WHERE 0",
}


@dataclass
class Ledger:
    """What clients know. told: what they were told last of each thing; open: what they have asked for, by the number of
    the request, and were not told, the newest of each thing last."""

    told: dict[str, Any] = field(default_factory=dict)
    open: dict[int, dict[str, Any]] = field(default_factory=dict)
    kinds: dict[int, str] = field(default_factory=dict)

    def take(self, mark: dict[str, Any]) -> None:
        """Read a mark."""
        number = mark["number"]
        if "wanted" in mark:
            self.open[number], self.kinds[number] = mark["wanted"], mark["kind"]
            return
        self.told |= mark["told"]
        # what was asked for before and not answered is overtaken
        self.open = {
            other: wanted
            for other, wanted in self.open.items()
            if other != number and (other > number or not wanted.keys() & mark["told"].keys())
        }

    @property
    def kind(self) -> set[str]:
        """Kinds of the requests under way."""
        return {self.kinds[number] for number in self.open}

    def compare(self, found: dict[str, Any]) -> list[str]:
        """What is not as it was told, or was not asked for."""
        wrong = []
        for name in sorted(self.told.keys() | found.keys() | {name for each in self.open.values() for name in each}):
            may = [self.told.get(name), *(each[name] for each in self.open.values() if name in each)]
            if ANY not in may and found.get(name) not in may:
                wrong.append(f"{name} is {found.get(name)!r}, expected {' or '.join(map(repr, may))}")
        return wrong


def facts(session: Session) -> dict[str, Any]:
    """What a database says, by the names of the story's marks."""
    found: dict[str, Any] = {}
    for kind, table in (("dataset", DatasetRow), ("robot", RobotRow)):
        for name, sha256 in session.execute(select(table.name, table.sha256)):
            assert f"{kind}/{name}" not in found, f"{kind} {name} is there twice"
            found[f"{kind}/{name}"] = sha256
    models = set()
    for model, version, made in session.execute(select(VersionRow.model, VersionRow.version, VersionRow.created_at)):
        found[f"version/{model}/{version}"] = made
        models.add(model)
    for model in models:
        found[f"alias/{model}/serving"] = registry.serving_version(session, model)
    for model, alias, version in session.execute(select(AliasRow.model, AliasRow.alias, AliasRow.version)):
        found[f"alias/{model}/{alias}"] = version
    jobs = select(JobRow.model, func.count(), func.count().filter(JobRow.state == "succeeded")).group_by(JobRow.model)
    for model, count, succeeded in session.execute(jobs):
        found |= {f"jobs/{model}": count} | ({f"trained/{model}": succeeded} if succeeded else {})
    for row in session.scalars(select(LearningRow)):
        found[f"learning/{row.model}"] = row.options["contact_threshold"]
    for name, revoked in session.execute(select(ApiKeyRow.name, ApiKeyRow.revoked_at)):
        found[f"key/{name}"] = "valid" if revoked is None else "revoked"
    return found | _batches(session)


def _batches(session: Session) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for row in session.scalars(select(EventRow).where(EventRow.kind == "batch").options(undefer(EventRow.payload))):
        taught, state = log.decode(row.payload or b""), "void" if row.void else "learnt"
        values = [getattr(taught, name) for name in ("q", "dq", "ddq", "tau")]
        assert row.sequence is not None
        if row.last_sequence == row.sequence and row.stream_id != "frames":
            parts = [(f"batch/{row.model}/{row.stream_id}/{row.sequence}", values)]
        else:
            each = zip(*values, strict=True)
            parts = [(f"frame/{row.model}/{row.stream_id}/{row.sequence + i}", list(one)) for i, one in enumerate(each)]
        for name, part in parts:
            assert name not in found, f"{name} is there twice"
            found[name] = f"{state} {digest(*part)}"
    return found


def check(home: Path, ledger: Ledger) -> list[str]:
    """What is wrong with a home that a service finds; whatever has learnt has to go on. Opens it as a start does."""
    settings = Settings(home=home)
    check_home(settings)
    database, files = Database.of(settings), Files.of(settings)
    try:
        start_sweeping(database, files)
        wrong = [str(each) for each in verify_home(settings).damages]
        with database.session() as session:
            found = facts(session)
            taught = sorted({name.split("/")[1] for name in found if name.startswith(("batch/", "frame/"))})
            numbers = {model: list(_numbers(session, model)) for model in taught}
        wrong += ledger.compare(found)
        for model, there in numbers.items():
            if there != list(range(1, len(there) + 1)):
                wrong.append(f"events of {model} have the numbers {there}")
            elif there and not wrong:
                wrong += _learns_on(database, files, settings, model)
        if sweep_unnamed(database, files):
            wrong.append("a second start finds something to sweep")
    finally:
        database.close()
    for folder, query in FOLDERS.items():
        named = {row[0] for row in rows(home, query)}
        if (there := names(home / folder)) != named:
            wrong.append(f"{folder} has {sorted(there - named)} too many and lacks {sorted(named - there)}")
    return wrong


def _numbers(session: Session, model: str) -> Iterable[int]:
    return session.scalars(select(EventRow.number).where(EventRow.model == model).order_by(EventRow.number))


def _learns_on(database: Database, files: Files, settings: Settings, model: str) -> list[str]:
    """Follow the log as the learner process does, and compare with learning all of it at once; store, and restore."""
    with database.session() as session:
        version = registry.serving_version(session, model)
        row = session.get_one(VersionRow, (model, version))
        newest = log.newest(session, model)
    base = files.load_version(row.folder, row.checksums)
    snapshots.sweep(database, files)
    follower = Follower(database, files, settings, model, version, base)
    while follower.behind:
        follower.step()
    if follower.number != newest:
        return [f"version {version} of {model} learns up to event {follower.number} of {newest}"]
    queries = np.random.default_rng(5).uniform(-1.5, 1.5, (3, 20, base.n_joints))
    found = follower.known.online.model().predict(*queries).tau
    with database.session() as session:
        expected = _at_once(base, session, model, follower.start).predict(*queries).tau
    if np.abs(found - expected).max() > CLOSE * np.abs(expected).max():
        return [f"version {version} of {model} has learnt something else than its log"]
    follower.store()
    with database.session() as session:
        stored = snapshots.find_latest(session, model, version, None)
    if follower.number > follower.start and (stored is None or stored.number != newest):
        return [f"version {version} of {model} could not be stored"]
    return []


def _at_once(base: Any, session: Session, model: str, start: int) -> Any:
    """What is learnt from all batches that are not taken back."""
    query = select(EventRow).where(EventRow.model == model, EventRow.number > start, EventRow.void.is_(False))
    kinds = query.where(EventRow.kind == "batch").order_by(EventRow.number).options(undefer(EventRow.payload))
    online = OnlineModel.start(base)
    for row in session.scalars(kinds):
        online = online.begin(row.received).learn(log.decode(row.payload or b""))
    return online.model()
