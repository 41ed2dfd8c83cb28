"""The points at which processes of the service are killed, and what has to be left of what was asked for."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from tests.service.faults import actions
from tests.service.faults.actions import Action
from tests.service.faults.injection import COMMIT, FSYNC, RENAME, Fault

FILES = "service.storage.files.store:Files"
LEARNER = "service.learning.learner"
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
    Point("upload: body received", actions.Upload, Fault("service.datasets.store:add"), "nothing"),
    Point(
        "upload: half of the file written",
        actions.Upload,
        Fault(RENAME, within=f"{FILES}.write_samples"),
        "nothing",
    ),
    Point(
        "upload: file complete, no row",
        actions.Upload,
        Fault(f"{FILES}.write_samples", "after"),
        "nothing",
    ),
    *_around_commit("upload", actions.Upload, "service.datasets.store:add"),
    *_around_commit("upload of a robot", actions.UploadRobot, "service.robots.store:add"),
    *_around_commit("deletion of a data set", actions.DeleteDataset, "service.datasets.store:delete"),
    Point(
        "deletion of a data set: before its file goes",
        actions.DeleteDataset,
        Fault(f"{FILES}.delete_samples"),
        "all",
    ),
]
WORK = "service.training.worker:_train"
JOBS = [
    *_around_commit("job queued", actions.Train, "service.training.jobs:create"),
    Point("job queued: before it is handed on", actions.Train, Fault("service.training.queue:JobQueue.submit"), "all"),
    *_both("job claimed", actions.Train, Fault(COMMIT, "after", "service.training.worker:_claim")),
    *_both("job at work: fit begun", actions.Train, Fault("lipcore.estimators.hyperparameters:fit", "before", WORK)),
    *_both("job at work: fit ended", actions.Train, Fault("service.training.planned_fit:PlannedFit.first", "after")),
    *_both("version: half of its files", actions.Train, Fault(FSYNC, "before", WORK)),
    *_both("version: files complete, no row", actions.Train, Fault(RENAME, "after", WORK)),
    *_both("version: row made", actions.Train, Fault("service.models.registry:publish", "after", WORK)),
    *_both("version: before the commit", actions.Train, Fault(COMMIT, "before", WORK)),
    *_both("version: after the commit", actions.Train, Fault(COMMIT, "after", WORK)),
    Point(
        "job at work: its process stands still",
        actions.Train,
        Fault("lipcore.estimators.hyperparameters:fit", "before", WORK, victim="frozen"),
        "all",
    ),
    *_around_commit("job cancelled while it runs", actions.Cancel, "service.training.jobs:cancel"),
]
POINTED = "service.models.loaded:LoadedModels.point"
APPEND = "service.learning.ingest.append:ObservationLog.append"
STORE = "service.journal.snapshots:save"
LEARNING = [
    Point("observation: row made", actions.Observe, Fault("service.journal.log:append_batch", "after"), "nothing"),
    *_around_commit("observation", actions.Observe, APPEND),
    *_around_commit("unlearning", actions.Unlearn, "service.learning.control.decisions:unlearn"),
    *_both("learner: page read", actions.Observe, Fault("service.journal.restore:advance", "before")),
    *_both("learner: publication written", actions.Observe, Fault(f"{LEARNER}.publication:write", "after")),
    Point("publication: before it is read", actions.Observe, Fault(f"{LEARNER}.publication:read"), "all"),
    *_both("snapshot: half of the file", actions.Observe, Fault(RENAME, "before", STORE)),
    *_both(
        "snapshot: file complete, no row",
        actions.Observe,
        Fault(f"{FILES}.write_snapshot", "after"),
    ),
    *_both("snapshot: before the commit", actions.Observe, Fault(COMMIT, "before", STORE)),
    *_both("snapshot: after the commit", actions.Observe, Fault(COMMIT, "after", STORE)),
    *_both(
        "snapshot: older ones still there",
        actions.ObserveOn,
        Fault(f"{FILES}.delete_snapshot", "before"),
    ),
]
MOVE = "service.models.aliases:_move"
MOVES = [
    Point(
        "other version serves: pointer moved", actions.Serve, Fault("service.models.registry:serve", "after"), "nothing"
    ),
    *_around_commit("other version serves", actions.Serve, "service.learning.control.decisions:_to_version"),
    Point(
        "other version serves: before it answers",
        actions.Serve,
        Fault("service.models.loaded:LoadedModels.adopt"),
        "all",
    ),
    *_around_commit("alias moved", actions.PointAlias, MOVE),
    Point("alias moved: before it answers", actions.PointAlias, Fault(POINTED, within=MOVE), "all"),
    *_around_commit("alias removed", actions.RemoveAlias, "service.models.aliases:remove"),
]
IMPORT = "service.models.archive_import:add"
ARCHIVES = [
    Point("import: archive received", actions.ImportModel, Fault(IMPORT), "nothing"),
    Point("import: half of the files", actions.ImportModel, Fault(FSYNC, within=IMPORT, skip=1), "nothing"),
    Point("import: files complete, no name", actions.ImportModel, Fault(RENAME, within=IMPORT), "nothing"),
    Point("import: files complete, no row", actions.ImportModel, Fault(RENAME, "after", IMPORT), "nothing"),
    *_around_commit("import", actions.ImportModel, "service.models.archive_import:_publish"),
]
REMOVE = "service.models.deletion:_remove_files"
DELETIONS = [
    *_around_commit("deletion of a version", actions.DeleteVersion, "service.models.deletion:delete_version"),
    Point("deletion of a version: before its files go", actions.DeleteVersion, Fault(REMOVE), "all"),
    *_around_commit("deletion of a model", actions.DeleteModel, "service.models.deletion:delete_model"),
    Point("deletion of a model: before its files go", actions.DeleteModel, Fault(REMOVE), "all"),
]
POINTS = [*UPLOADS, *JOBS, *LEARNING, *MOVES, *ARCHIVES, *DELETIONS]
RECOVER = "service.training.queue:JobQueue.recover"
STARTS = {
    "the home is held": Fault("service.app:_open", victim="itself"),
    "all is swept": Fault(f"{FILES}.sweep", "after", victim="itself"),
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
