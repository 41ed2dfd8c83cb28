"""Check the request of a training job before it is queued."""

from __future__ import annotations

from collections.abc import Sequence

from lipcore import extras
from lipcore.estimators.base import BaseMismatchError, RobotKind, check_base
from lipcore.estimators.catalogue import UnknownEstimatorError, check_estimator
from lipcore.estimators.options import FitOptions
from lipcore.robots.library import ROBOTS
from lipcore.vocabulary import AUTO, ESTIMATOR_CHOICES, ROBOT_ESTIMATORS, TORCH_ESTIMATORS
from service.contract.jobs import MAX_OPTIONS, JobDraft, JobRequest
from service.datasets import store
from service.datasets.mapping.checks import MIN_SAMPLES
from service.foundation.errors import InvalidRequestError, invalid_request, problem
from service.foundation.fields import first_repeat
from service.models import registry
from service.robots import store as robots
from service.storage.database import Database, DatasetRow, VersionRow
from service.training import holding_out
from service.training.queue import JobQueue

MAX_DATASETS = 100
"""Maximum data sets of one training job."""


def check(queue: JobQueue, request: JobRequest) -> tuple[list[DatasetRow], list[str], VersionRow | None]:
    """Check a request; return its data sets, their joint types and the version to start from.

    Raise InvalidRequestError or NotFoundError.
    """
    _check_options(request)
    if len(request.datasets) > MAX_DATASETS:
        raise invalid_request("datasets", len(request.datasets), f"at most {MAX_DATASETS}")
    rows = [store.find(queue.database, dataset) for dataset in request.datasets]
    joint_types = _check_joints(request, rows)
    kind = RobotKind(tuple(rows[0].joint_names), tuple(joint_types), rows[0].torque_convention)
    with queue.database.session() as session:
        registry.check_robot(session, request.model, kind)
    if request.holdout is not None:
        holding_out.check(rows, request.holdout, MIN_SAMPLES)
    if queue.settings.cluster is None:  # else the workers check it
        _check_extra(request)
    if request.base is None:
        _check_estimator(queue.database, request, rows[0].joint_names, joint_types)
        return rows, joint_types, None
    base = registry.find_named(queue.database, request.base)
    _check_base(base, request, rows[0], joint_types)
    return rows, joint_types, base


def check_draft(queue: JobQueue, draft: JobDraft) -> None:
    """Check a draft as `check` does, as far as possible without data sets."""
    if draft.datasets:
        check(queue, draft)
        return
    _check_options(draft)
    if draft.base is not None:
        registry.find_named(queue.database, draft.base)
    if draft.estimator not in ESTIMATOR_CHOICES:
        raise invalid_request("estimator", draft.estimator, f"one of {', '.join(ESTIMATOR_CHOICES)}")
    if queue.settings.cluster is None:
        _check_extra(draft)
    if draft.robot is not None and draft.estimator not in (AUTO, *ROBOT_ESTIMATORS):
        raise invalid_request("robot", draft.robot, "no robot", f"`robot` is not used by estimator {draft.estimator}.")
    if draft.robot is not None and draft.robot not in ROBOTS:
        robots.profile_of(queue.database, draft.robot)


def with_default_robot(
    database: Database, request: JobRequest, rows: Sequence[DatasetRow], joint_types: Sequence[str]
) -> JobRequest:
    """Return a request with the robot of its data sets, unless it names one, null or arms, or its estimator uses none.

    A robot without a usable URDF is not used: such data sets only have its limits.
    """
    # of an uploaded URDF, the report has only the name
    known = {(row.report.get("upload_options") or {}).get("robot") or row.report.get("robot") for row in rows}
    uses_robot = request.base is None and request.estimator in (AUTO, *ROBOT_ESTIMATORS)
    told = "robot" in request.model_fields_set or request.options.arms
    if told or not uses_robot or len(known) != 1 or (robot := known.pop()) is None:
        return request
    try:
        robots.resolve(database, robot, rows[0].joint_names, joint_types)
    except (ValueError, extras.MissingExtraError):
        return request
    return request.model_copy(update={"robot": robot})


def _check_joints(request: JobRequest, rows: list[DatasetRow]) -> list[str]:
    first = rows[0]
    if (twice := first_repeat(row.id for row in rows)) is not None:
        field, value = f"datasets[{twice}]", request.datasets[twice]
        raise invalid_request(field, value, "no data set twice", f"`{field}` repeats data set {value}.")
    for index, row in enumerate(rows):
        for what in ("joint_names", "torque_convention"):
            if getattr(row, what) != getattr(first, what):
                field, own, others = f"datasets[{index}]", getattr(row, what), getattr(first, what)
                message = f"`{what}` of data set {row.id} is {own}, that of {first.id} is {others}."
                raise invalid_request(field, f"a data set with {what} {own}", f"{what} {others}", message)
    n = len(first.joint_names)
    known = next((each for row in rows if (each := row.report.get("joint_types")) is not None), ["revolute"] * n)
    types: list[str] = list(known if request.joint_types is None else request.joint_types)
    if len(types) != n:
        names = ", ".join(first.joint_names)
        message = f"`joint_types` has {len(types)} entries; the data have {n} joints: {names}."
        raise invalid_request("joint_types", f"{len(types)} types", f"{n} types, one for each joint: {names}", message)
    return types


def _check_estimator(database: Database, request: JobRequest, joint_names: list[str], joint_types: list[str]) -> None:
    """Run the checks of the training process, so that invalid requests are rejected early."""
    try:
        robot = None
        if request.robot is not None:
            robot = robots.resolve(database, request.robot, joint_names, joint_types)
        check_estimator(request.estimator, joint_types, robot, FitOptions(**request.options.model_dump()))
    except UnknownEstimatorError as error:
        expected = str(error).partition("expected ")[2]
        raise invalid_request("estimator", request.estimator, expected) from None
    except ValueError as error:
        detail = problem("robot", request.robot, "a profile or the id of an uploaded URDF, with the joints of the data")
        raise InvalidRequestError(str(error), [detail]) from None


def _check_extra(request: JobRequest) -> None:
    """Raise MissingExtraError if the training process would."""
    if request.estimator in TORCH_ESTIMATORS:
        extras.check_extra("train")


def _check_base(base: VersionRow, request: JobRequest, data: DatasetRow, joint_types: list[str]) -> None:
    """Check that the training can start from a version."""
    manifest = base.manifest
    of_base = RobotKind.of_manifest(manifest)
    of_data = RobotKind(tuple(data.joint_names), tuple(joint_types), data.torque_convention)
    geometry = manifest["parameters"].get("geometry", {})
    arms = 1 + sum(joint.get("root", False) for joint in geometry.get("joints", ()))
    options, name = FitOptions(**request.options.model_dump()), f"{base.model}:{base.version}"
    try:
        check_base(name, of_base, geometry.get("order"), of_data, request.estimator, options, request.robot, arms)
    except BaseMismatchError as error:
        raise invalid_request(error.field, error.value, error.expected) from None


def _check_options(request: JobRequest) -> None:
    options = request.options
    for name, most in MAX_OPTIONS.items():
        if getattr(options, name) > most:
            raise invalid_request(f"options.{name}", getattr(options, name), f"at most {most}")
    try:
        FitOptions(**options.model_dump()).check_device(request.estimator)
    except ValueError as error:
        raise InvalidRequestError(str(error), [problem("options.device", options.device, "auto or cpu")]) from None
