"""The points at which processes of the service are killed, and what has to be left of what was asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from tests.service.faults import actions
from tests.service.faults.actions import Action
from tests.service.faults.injection import COMMIT, FSYNC, RENAME, Fault

Left = Literal["all", "nothing"]


@dataclass(frozen=True)
class Point:
    """One point. left: what remains of what was asked for and not answered."""

    name: str
    action: Callable[[], Action]
    fault: Fault
    left: Left


def _around_commit(name: str, action: Callable[[], Action], within: str) -> list[Point]:
    return [
        Point(f"{name}: before the commit", action, Fault(COMMIT, "before", within), "nothing"),
        Point(f"{name}: after the commit, before the answer", action, Fault(COMMIT, "after", within), "all"),
    ]


def _both(name: str, action: Callable[[], Action], fault: Fault) -> list[Point]:
    """The process alone, and the service with it; what was asked for happens in the end."""
    return [
        Point(f"{name}, process alone", action, replace(fault, victim="itself"), "all"),
        Point(f"{name}, with the service", action, fault, "all"),
    ]


UPLOADS = [
    Point("upload: body received", actions.upload, Fault("service.datasets.store:add"), "nothing"),
    Point(
        "upload: half of the file written",
        actions.upload,
        Fault(RENAME, within="service.storage.files.store:Files.write_samples"),
        "nothing",
    ),
    Point(
        "upload: file complete, no row",
        actions.upload,
        Fault("service.storage.files.store:Files.write_samples", "after"),
        "nothing",
    ),
    *_around_commit("upload", actions.upload, "service.datasets.store:add"),
    *_around_commit("upload of a robot", actions.upload_robot, "service.robots.store:add"),
    *_around_commit("deletion of a data set", actions.delete_dataset, "service.datasets.store:delete"),
    Point(
        "deletion of a data set: before its file goes",
        actions.delete_dataset,
        Fault("service.storage.files.store:Files.delete_samples"),
        "all",
    ),
]
WORK = "service.training.worker:_train"
JOBS = [
    *_around_commit("job queued", actions.train, "service.training.jobs:create"),
    Point("job queued: before it is handed on", actions.train, Fault("service.training.queue:JobQueue.submit"), "all"),
    *_both("job claimed", actions.train, Fault(COMMIT, "after", "service.training.worker:_claim")),
    *_both("job at work: fit begun", actions.train, Fault("lipcore.fitting.hyperparameters:fit", "before", WORK)),
    *_both("job at work: fit ended", actions.train, Fault("service.training.worker:_fit", "after")),
    *_both("version: half of its files", actions.train, Fault(FSYNC, "before", WORK)),
    *_both("version: files complete, no row", actions.train, Fault(RENAME, "after", WORK)),
    *_both("version: row made", actions.train, Fault("service.models.registry:publish", "after", WORK)),
    *_both("version: before the commit", actions.train, Fault(COMMIT, "before", WORK)),
    *_both("version: after the commit", actions.train, Fault(COMMIT, "after", WORK)),
    Point(
        "job at work: its process stands still",
        actions.train,
        Fault("lipcore.fitting.hyperparameters:fit", "before", WORK, victim="frozen"),
        "all",
    ),
    *_around_commit("job cancelled while it runs", actions.cancel, "service.training.jobs:cancel"),
]
POINTED = "service.models.loaded:LoadedModels.point"
APPEND = "service.learning.ingest.intake:Intake.append"
STORE = "service.journal.snapshots:save"
LEARNING = [
    Point("observation: row made", actions.observe, Fault("service.journal.log:append_batch", "after"), "nothing"),
    *_around_commit("observation", actions.observe, APPEND),
    *_around_commit("unlearning", actions.unlearn, "service.learning.control.decisions:unlearn"),
    *_both("learner: page read", actions.observe, Fault("service.learning.learner.restore:advance", "before")),
    *_both(
        "learner: publication written", actions.observe, Fault("service.learning.learner.publication:write", "after")
    ),
    Point("publication: before it is read", actions.observe, Fault("service.learning.learner.publication:read"), "all"),
    *_both("snapshot: half of the file", actions.observe, Fault(RENAME, "before", STORE)),
    *_both(
        "snapshot: file complete, no row",
        actions.observe,
        Fault("service.storage.files.store:Files.write_snapshot", "after"),
    ),
    *_both("snapshot: before the commit", actions.observe, Fault(COMMIT, "before", STORE)),
    *_both("snapshot: after the commit", actions.observe, Fault(COMMIT, "after", STORE)),
    *_both(
        "snapshot: older ones still there",
        actions.observe_on,
        Fault("service.storage.files.store:Files.delete_snapshot", "before"),
    ),
]
MOVE = "service.models.aliases:_move"
MOVES = [
    Point(
        "other version serves: pointer moved", actions.serve, Fault("service.models.registry:serve", "after"), "nothing"
    ),
    *_around_commit("other version serves", actions.serve, "service.learning.control.decisions:_to_version"),
    Point(
        "other version serves: before it answers",
        actions.serve,
        Fault("service.models.loaded:LoadedModels.adopt"),
        "all",
    ),
    *_around_commit("alias moved", actions.point_alias, MOVE),
    Point("alias moved: before it answers", actions.point_alias, Fault(POINTED, within=MOVE), "all"),
    *_around_commit("alias removed", actions.remove_alias, "service.models.aliases:remove"),
]
IMPORT = "service.models.archive_import:add"
ARCHIVES = [
    Point("import: archive received", actions.import_model, Fault(IMPORT), "nothing"),
    Point("import: half of the files", actions.import_model, Fault(FSYNC, within=IMPORT, skip=1), "nothing"),
    Point("import: files complete, no name", actions.import_model, Fault(RENAME, within=IMPORT), "nothing"),
    Point("import: files complete, no row", actions.import_model, Fault(RENAME, "after", IMPORT), "nothing"),
    *_around_commit("import", actions.import_model, "service.models.archive_import:_publish"),
]
REMOVE = "service.models.deletion:_remove_files"
DELETIONS = [
    *_around_commit("deletion of a version", actions.delete_version, "service.models.deletion:delete_version"),
    Point("deletion of a version: before its files go", actions.delete_version, Fault(REMOVE), "all"),
    *_around_commit("deletion of a model", actions.delete_model, "service.models.deletion:delete_model"),
    Point("deletion of a model: before its files go", actions.delete_model, Fault(REMOVE), "all"),
]
POINTS = [*UPLOADS, *JOBS, *LEARNING, *MOVES, *ARCHIVES, *DELETIONS]
RECOVER = "service.training.queue:JobQueue.recover"
STARTS = {
    "the home is held": Fault("service.app:_open", victim="itself"),
    "all is swept": Fault("service.storage.files.store:Files.sweep", "after", victim="itself"),
    "before jobs are queued again": Fault(COMMIT, "before", RECOVER, "itself"),
    "jobs are queued again": Fault(COMMIT, "after", RECOVER, "itself"),
}
"""Points of a start after a kill."""
INSTALL = "service.models.registry:install_shipped"
FIRST_STARTS = {
    "before the tables are committed": Fault("service.storage.database.migrations:_upgrade", "after", victim="itself"),
    "half of the shipped model": Fault(FSYNC, "before", INSTALL, "itself", skip=1),
    "the shipped model complete, no row": Fault(RENAME, "after", INSTALL, "itself"),
    "before the commit of the shipped model": Fault(COMMIT, "before", INSTALL, "itself"),
    "after the commit of the shipped model": Fault(COMMIT, "after", INSTALL, "itself"),
}
"""Points of a start on an empty home."""
FAULTS = [*(point.fault for point in POINTS), *STARTS.values(), *FIRST_STARTS.values()]
TARGETS = {fault.target for fault in FAULTS}
