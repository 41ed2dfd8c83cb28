"""Checks of a home that a power cut has left: everything acknowledged is there, and nothing is partial."""

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
from tests.system.faults.ledger import FOLDERS, MAX_RELATIVE_DIFFERENCE, file_names, query_rows
from tests.system.power.scenarios import ANY, digest


@dataclass
class Ledger:
    """What clients know. acknowledged: the last acknowledged state of each thing; pending: states that unanswered
    requests ask for, by request number."""

    acknowledged: dict[str, Any] = field(default_factory=dict)
    pending: dict[int, dict[str, Any]] = field(default_factory=dict)
    kinds: dict[int, str] = field(default_factory=dict)

    def read_mark(self, mark: dict[str, Any]) -> None:
        """Update from a mark of the recording."""
        number = mark["number"]
        if "wanted" in mark:
            self.pending[number], self.kinds[number] = mark["wanted"], mark["kind"]
            return
        self.acknowledged |= mark["acknowledged"]
        # the new state replaces those of earlier unanswered requests
        self.pending = {
            other: wanted
            for other, wanted in self.pending.items()
            if other != number and (other > number or not wanted.keys() & mark["acknowledged"].keys())
        }

    @property
    def pending_kinds(self) -> set[str]:
        """Kinds of the unanswered requests."""
        return {self.kinds[number] for number in self.pending}

    def compare(self, found: dict[str, Any]) -> list[str]:
        """Return the differences between a home and what was acknowledged or requested."""
        problems = []
        for name in sorted(
            self.acknowledged.keys() | found.keys() | {name for each in self.pending.values() for name in each}
        ):
            may = [self.acknowledged.get(name), *(each[name] for each in self.pending.values() if name in each)]
            if ANY not in may and found.get(name) not in may:
                problems.append(f"{name} is {found.get(name)!r}, expected {' or '.join(map(repr, may))}")
        return problems


def read_facts(session: Session) -> dict[str, Any]:
    """Return the content of a database under the names that the marks use."""
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
    return found | _batch_facts(session)


def _batch_facts(session: Session) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for row in session.scalars(select(EventRow).where(EventRow.kind == "batch").options(undefer(EventRow.payload))):
        rows, state = log.decode(row.payload or b""), "void" if row.void else "learnt"
        values = [getattr(rows, name) for name in ("q", "dq", "ddq", "tau")]
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


def find_problems(home: Path, ledger: Ledger) -> list[str]:
    """Return what is wrong with a home. Opens it as a start of the service does, and continues its learning."""
    settings = Settings(home=home)
    check_home(settings)
    database, files = Database.of(settings), Files.of(settings)
    try:
        start_sweeping(database, files)
        problems = [str(each) for each in verify_home(settings).damages]
        with database.session() as session:
            found = read_facts(session)
            learning_models = sorted({name.split("/")[1] for name in found if name.startswith(("batch/", "frame/"))})
            numbers = {model: list(_numbers(session, model)) for model in learning_models}
        problems += ledger.compare(found)
        for model, there in numbers.items():
            if there != list(range(1, len(there) + 1)):
                problems.append(f"events of {model} have the numbers {there}")
            elif there and not problems:
                problems += _find_learning_problems(database, files, settings, model)
        if sweep_unnamed(database, files):
            problems.append("a second start still finds files to delete")
    finally:
        database.close()
    for folder, query in FOLDERS.items():
        named = {row[0] for row in query_rows(home, query)}
        if (there := file_names(home / folder)) != named:
            problems.append(f"{folder} has {sorted(there - named)} too many and lacks {sorted(named - there)}")
    return problems


def _numbers(session: Session, model: str) -> Iterable[int]:
    return session.scalars(select(EventRow.number).where(EventRow.model == model).order_by(EventRow.number))


def _find_learning_problems(database: Database, files: Files, settings: Settings, model: str) -> list[str]:
    """Follow the log as the learner process does, compare with learning it at once, then store and restore."""
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
        expected = _learn_at_once(base, session, model, follower.start).predict(*queries).tau
    if np.abs(found - expected).max() > MAX_RELATIVE_DIFFERENCE * np.abs(expected).max():
        return [f"version {version} of {model} has learnt something else than its log"]
    follower.store()
    with database.session() as session:
        stored = snapshots.find_latest(session, model, version, None)
    if follower.number > follower.start and (stored is None or stored.number != newest):
        return [f"version {version} of {model} could not be stored"]
    return []


def _learn_at_once(base: Any, session: Session, model: str, start: int) -> Any:
    """Return the model that learns all batches that were not undone."""
    query = select(EventRow).where(EventRow.model == model, EventRow.number > start, EventRow.void.is_(False))
    kinds = query.where(EventRow.kind == "batch").order_by(EventRow.number).options(undefer(EventRow.payload))
    online = OnlineModel.start(base)
    for row in session.scalars(kinds):
        online = online.begin(row.received).learn(log.decode(row.payload or b""))
    return online.model()
