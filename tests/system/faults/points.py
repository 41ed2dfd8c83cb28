"""Points at which processes of the service are killed, and the expected outcome of the interrupted request."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from tests.system.faults import actions
from tests.system.faults.actions import Action
from tests.system.faults.injection import COMMIT, FSYNC, RENAME, Fault

FILES = "service.storage.files.store:Files"
LEARNER = "service.learning.learner"
Left = Literal["all", "nothing"]


@dataclass(frozen=True)
class Point:
    """A point. left: how much of an unanswered request must remain afterwards."""

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
    """Kill the process alone, or the service too; either way the request takes effect in the end."""
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
        "deletion of a data set: before its file is removed",
        actions.DeleteDataset,
        Fault(f"{FILES}.delete_dataset"),
        "all",
    ),
]
WORK = "service.training.worker:_train"
JOBS = [
    *_around_commit("job queued", actions.Train, "service.training.jobs:create"),
    Point("job queued: before submission", actions.Train, Fault("service.training.queue:JobQueue.submit"), "all"),
    *_both("job claimed", actions.Train, Fault(COMMIT, "after", "service.training.worker:_claim")),
    *_both("job running: fit started", actions.Train, Fault("lipcore.estimators.hyperparameters:fit", "before", WORK)),
    *_both("job running: fit finished", actions.Train, Fault("service.training.planned_fit:PlannedFit.first", "after")),
    *_both("version: half of its files", actions.Train, Fault(FSYNC, "before", WORK)),
    *_both("version: files complete, no row", actions.Train, Fault(RENAME, "after", WORK)),
    *_both("version: row made", actions.Train, Fault("service.models.registry:publish", "after", WORK)),
    *_both("version: before the commit", actions.Train, Fault(COMMIT, "before", WORK)),
    *_both("version: after the commit", actions.Train, Fault(COMMIT, "after", WORK)),
    Point(
        "job running: process frozen",
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
        "snapshot: before older ones are removed",
        actions.ObserveOn,
        Fault(f"{FILES}.delete_snapshot", "before"),
    ),
]
MOVE = "service.models.aliases:_move"
MOVES = [
    Point("serving version: pointer moved", actions.Serve, Fault("service.models.registry:serve", "after"), "nothing"),
    *_around_commit("serving version", actions.Serve, "service.learning.control.decisions:_to_version"),
    Point(
        "serving version: before it is loaded",
        actions.Serve,
        Fault("service.models.loaded:LoadedModels.adopt"),
        "all",
    ),
    *_around_commit("alias moved", actions.PointAlias, MOVE),
    Point("alias moved: before it is loaded", actions.PointAlias, Fault(POINTED, within=MOVE), "all"),
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
    Point("deletion of a version: before its files are removed", actions.DeleteVersion, Fault(REMOVE), "all"),
    *_around_commit("deletion of a model", actions.DeleteModel, "service.models.deletion:delete_model"),
    Point("deletion of a model: before its files are removed", actions.DeleteModel, Fault(REMOVE), "all"),
]
POINTS = [*UPLOADS, *JOBS, *LEARNING, *MOVES, *ARCHIVES, *DELETIONS]
RECOVER = "service.training.queue:JobQueue.recover"
STARTS = {
    "home locked": Fault("service.app:_open", victim="itself"),
    "after the sweep": Fault(f"{FILES}.sweep", "after", victim="itself"),
    "before interrupted jobs are requeued": Fault(COMMIT, "before", RECOVER, "itself"),
    "interrupted jobs requeued": Fault(COMMIT, "after", RECOVER, "itself"),
}
"""Points during a start after a kill."""
INSTALL = "service.models.shipped:install_shipped"
FIRST_STARTS = {
    "before the tables are committed": Fault("service.storage.database.migrations:_upgrade", "after", victim="itself"),
    "half of the shipped model written": Fault(FSYNC, "before", INSTALL, "itself", skip=1),
    "the shipped model complete, no row": Fault(RENAME, "after", INSTALL, "itself"),
    "before the commit of the shipped model": Fault(COMMIT, "before", INSTALL, "itself"),
    "after the commit of the shipped model": Fault(COMMIT, "after", INSTALL, "itself"),
}
"""Points during the first start, on an empty home."""
FAULTS = [*(point.fault for point in POINTS), *STARTS.values(), *FIRST_STARTS.values()]
TARGETS = {fault.target for fault in FAULTS}
