"""The cells of a run, and the computation of missing results."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console

from benchmarks.real import figaroh_fit, mujoco_forward, mujoco_sysid, product, rivals
from benchmarks.real.cells import BASE_FRICTION, PRODUCT, Cache, Cell, Result, evaluate_forecast
from benchmarks.real.peers import Peer
from benchmarks.real.product import Bed, open_bed
from benchmarks.real.recordings import RECORDINGS, Recording, prepare
from benchmarks.real.rivals import Forecast, Predict
from benchmarks.real.splits import Split, splits
from lipcore.arm import drive
from lipcore.data.metrics import LEVEL, quantile
from lipcore.data.samples import Samples
from lipcore.robots.urdf import RigidBody
from lipcore.training.train import train
from lipcore.vocabulary import AUTO, JointType

ALONE: Mapping[str, Predict] = {"mean": rivals.predict_mean, "RBF ridge": rivals.predict_rbf}
"""Other methods without knowledge of the robot."""
WITH_BODY: Mapping[str, Callable[[RigidBody, Samples, Samples], Forecast]] = {
    "least squares": rivals.predict_least_squares,
    "Bayesian least squares": rivals.predict_bayesian,
    "mujoco.sysid": mujoco_sysid.predict_mujoco,
    "mujoco.sysid, forward": mujoco_forward.predict_forward,
    "FIGAROH": figaroh_fit.predict_figaroh,
}
"""Other methods that know the URDF."""
OPTIONAL = {
    "mujoco.sysid": mujoco_sysid.is_installed,
    "mujoco.sysid, forward": mujoco_sysid.is_installed,
    "FIGAROH": figaroh_fit.is_installed,
}
"""Methods that may not be installed, and functions that check it."""

PEERS: Mapping[str, Peer] = {
    PRODUCT: product.PEER,
    "FIGAROH": figaroh_fit.PEER,
    "mujoco.sysid": mujoco_sysid.PEER,
    "mujoco.sysid, forward": mujoco_forward.PEER,
}
"""Facts about LIPServe and about methods of others."""

Service = Callable[[], Bed]
"""A function that returns the service and starts it on the first call."""


@dataclass(frozen=True)
class Options:
    """Options of a run.

    Attributes:
        folder: folder of the recordings.
        out: folder of the results.
        revision: revision of LIPServe.
        only: regular expression to find in the name of a cell.
        jobs: cells computed at a time.
        compute: whether missing results are computed.
        recordings: the recordings.
    """

    folder: Path
    out: Path
    revision: str
    only: str = ""
    jobs: int = 1
    compute: bool = True
    recordings: Sequence[Recording] = RECORDINGS


@dataclass(frozen=True)
class Plan:
    """Recording and split of each cell, and splits for which a recording is too short, with the reason."""

    work: Mapping[Cell, tuple[Recording, Split]]
    skipped: Mapping[str, str]


@dataclass(frozen=True)
class Outcome:
    """Results of a plan, skipped splits, errors of failed cells by name, and methods that are not installed."""

    results: Sequence[Result]
    skipped: Mapping[str, str]
    failed: Mapping[str, str]
    absent: Sequence[str]


def run(options: Options, console: Console) -> Outcome:
    """Compute the missing results and return all; raise BenchError if a recording is missing."""
    cache = Cache(options.out / "cells", options.revision)
    with _service(options.jobs) as service:
        plan = make_plan(options, service)
        absent = [method for method, is_installed in OPTIONAL.items() if not is_installed()]
        wanted = [cell for cell in plan.work if options.compute and cell.method not in absent]
        missing = [cell for cell in wanted if cache.find(cell) is None]
        console.print(f"{len(plan.work)} cells of {options.revision}, {len(missing)} to compute", highlight=False)
        failed = _compute_all(missing, plan, cache, options.jobs, service, console)
    results = [result for cell in plan.work if (result := cache.find(cell)) is not None]
    return Outcome(results, plan.skipped, failed, absent)


def make_plan(options: Options, service: Service) -> Plan:
    """Prepare the recordings; return the cells with names that match `only`."""
    work, all_skipped = {}, {}
    for recording in options.recordings:
        found, skipped = splits(prepare(recording, options.folder, options.out / "prepared", service))
        all_skipped.update({f"{recording.name}/{split}": why for split, why in skipped.items()})
        for name, split in found.items():
            for cell in _cells(recording, name):
                if re.search(options.only, str(cell)):
                    work[cell] = recording, split
    return Plan(work, all_skipped)


def _cells(recording: Recording, split: str) -> Iterator[Cell]:
    for method in (PRODUCT, BASE_FRICTION, *ALONE):
        yield Cell(recording=recording.name, split=split, knowledge="nothing", method=method)
    if recording.robot is not None:
        for method in (PRODUCT, BASE_FRICTION, *WITH_BODY):
            yield Cell(recording=recording.name, split=split, knowledge="URDF", method=method)


def compute_cell(cell: Cell, recording: Recording, split: Split, service: Service) -> Result:
    """Train on the training samples of a split and predict its test, without the test's torque."""
    states = replace(split.test, tau=np.full_like(split.test.tau, np.nan))
    if cell.method == PRODUCT:
        bed, types = service(), recording.joint_types(split.train.n_joints)
        robot = recording.robot if cell.knowledge == "URDF" else None
        name = f"{cell.recording}-{cell.split}-{cell.knowledge}".lower()
        trained = bed.train(name, [bed.upload(name, split.train)], types, robot)
        return evaluate_forecast(cell, split, bed.predict(trained, states), trained.seconds, trained.estimator)
    known = cell.knowledge == "URDF"
    if cell.method == BASE_FRICTION:
        body = recording.body(split.train) if known else None
        return predict_with_base_friction(cell, split, states, recording.joint_types(split.train.n_joints), body)
    predict = partial(WITH_BODY[cell.method], recording.body(split.train)) if known else ALONE[cell.method]
    began = time.monotonic()
    forecast = predict(split.train, states)
    return evaluate_forecast(cell, split, forecast, time.monotonic() - began)


def predict_with_base_friction(
    cell: Cell, split: Split, states: Samples, joint_types: Sequence[JointType], body: RigidBody | None
) -> Result:
    """Train without kinds of friction that a recording has to support, and predict the states of a split's test."""
    began = time.monotonic()
    drive.OPTIONS = replace(drive.OPTIONS, kinds=())  # the service trains in another process
    model = train(split.train, joint_types, AUTO, robot=body)
    seconds = time.monotonic() - began
    answer = model.predict_along(states).interval
    forecast = Forecast(answer.mean, answer.half_width / quantile(LEVEL))
    return evaluate_forecast(cell, split, forecast, seconds, model.estimator.name)


def _compute_all(
    cells: Sequence[Cell], plan: Plan, cache: Cache, jobs: int, service: Service, console: Console
) -> dict[str, str]:
    """Compute cells, `jobs` at a time, and store each result; return the errors of failed cells."""
    failed = {}
    with ThreadPoolExecutor(jobs) as pool:
        running = {pool.submit(compute_cell, cell, *plan.work[cell], service): cell for cell in cells}
        try:
            for done, future in enumerate(as_completed(running), start=1):
                cell, error = running[future], future.exception()
                if error is None:
                    result = future.result()
                    cache.add(result)
                    outcome = f"nMSE {result.error:.1e}, {result.seconds:.1f} s {result.estimator}"
                else:
                    failed[str(cell)] = outcome = f"{type(error).__name__}: {error}"
                console.print(f"  {done}/{len(cells)}  {cell}: {outcome}", highlight=False, markup=False)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return failed


@contextmanager
def _service(jobs: int) -> Iterator[Service]:
    beds: list[Bed] = []
    lock = threading.Lock()
    with ExitStack() as stack:

        def service() -> Bed:
            with lock:
                if not beds:
                    beds.append(stack.enter_context(open_bed(jobs)))
                return beds[0]

        yield service
