"""`lipserve excite`: plan the motion that reduces a model's uncertainty most, within the limits of its robot."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

import lipcore
from lipcore import profiles
from lipcore.data.samples import Array
from lipcore.estimators.catalogue import ESTIMATORS
from lipcore.excitation import Belief, Limits, Plan, PlanOptions, plan
from lipcore.extras import MissingExtraError
from lipcore.files import persistence
from lipcore.files.manifest import DEFAULT_LIMITS, MANIFEST, ROBOT, TENSORS, ModelFormatError
from lipcore.model.torque_model import TorqueModel
from lipcore.posterior.linalg import NotPositiveDefiniteError
from lipcore.profiles import Profile, names
from lipcore.robots.library import ROBOTS, Robot, load_robot
from lipcore.robots.simulation import FAST_SPEED, Simulation, sinusoids
from lipcore.robots.urdf import RigidBody
from lipcore.vocabulary import JointType
from lipserve import ApiError, Client
from lipserve.address import DEFAULT_URL, URL_VARIABLE
from service.cli import plotting
from service.cli.consoles import err, print_json
from service.cli.options import Json, alone
from service.foundation.text import counted, percent
from service.models import archive_reading as archive

MAX_URDF_BYTES = 16 * 1024 * 1024


@dataclass(frozen=True)
class Arm:
    """Limits and dynamics of a robot. robot: None without a URDF; bodies: for rigid-body estimators."""

    name: str
    limits: Limits
    robot: Robot | None
    bodies: RigidBody | None


def find(given: str | None, model: TorqueModel | None) -> Arm:
    """Return the given robot (a name or .urdf file), or else the one that matches the model's joints.

    Its joints get the model's names. Raise ValueError or OSError if there is no such robot or it does not fit.
    """
    if given is None:
        if model is None:
            raise ValueError("give --robot or --model: the plan needs the limits of the robot")
        return _of_model(model)
    if not given.endswith(".urdf"):
        return _named(given, model)
    path = Path(given)
    if (size := path.stat().st_size) > MAX_URDF_BYTES:
        raise ValueError(f"{given} has {size} bytes; the maximum is {MAX_URDF_BYTES}")
    profile = profiles.from_urdf(path.read_text(encoding="utf-8"), path.stem)
    names = profile.joint_names
    if model is not None and set(model.joint_names) <= set(names):  # other joints, such as grippers, do not move
        names = model.joint_names
    return _of_urdf(profile, names, None if model is None else model.joint_names)


def _of_model(model: TorqueModel) -> Arm:
    if model.robot is not None:
        profile = profiles.from_urdf(model.robot.urdf, model.robot.name)
        return _of_urdf(profile, model.robot.urdf_joints, model.joint_names)
    names = profiles.recognise(model.joint_names)
    if len(names) != 1:
        found = f"several robots: {', '.join(names)}" if names else "no known robot"
        raise ValueError(
            f"the model's joints {', '.join(model.joint_names)} match {found}. Set --robot to a .urdf file or one of "
            f"{', '.join(profiles.names())}"
        )
    return _named(names[0], model)


def _named(name: str, model: TorqueModel | None) -> Arm:
    profile = profiles.profile(name)
    names = profile.joint_names if model is None else model.joint_names
    _check(profile, profile.joint_names, names)
    limits = replace(Limits.of_profile(profile), joint_names=names)
    robot, bodies = None, None
    if name in ROBOTS:
        try:
            robot = load_robot(name)
        except MissingExtraError:  # the limits are known without it
            return Arm(name, limits, None, None)
        bodies = RigidBody.from_profile(name, robot.joint_names, robot.joint_types)
    return Arm(name, limits, robot, bodies)


def _of_urdf(profile: Profile, joints: Sequence[str], names: tuple[str, ...] | None) -> Arm:
    """joints: moving joints of the URDF; names: their names in the data."""
    if profile.urdf is None:
        raise ValueError(f"robot {profile.name!r} has no URDF")
    places = [profile.joint_names.index(joint) for joint in joints]
    types = [profile.joint_types[place] for place in places]
    bodies = RigidBody.from_urdf(profile.urdf, joints, types, name=profile.name)
    if bodies.order != tuple(range(len(bodies.order))):
        raise ValueError(f"the joints of {profile.name!r} are not ordered from base to tip: {', '.join(joints)}")
    called = bodies.joint_names if names is None else names
    _check(profile, bodies.joint_names, called)
    every = Limits.of_profile(profile)
    parts = (getattr(every, name)[places] for name in ("lower", "upper", "speed", "acceleration", "torque"))
    limits = Limits(called, *parts)
    robot = Robot(profile.name, bodies.model, called, bodies.joint_types, limits.lower, limits.upper, limits.speed)
    return Arm(profile.name, limits, robot, replace(bodies, joint_names=called))


def _check(profile: Profile, own: Sequence[str], called: Sequence[str]) -> None:
    """Check that the model has the robot's joints in the same order; their names may differ."""
    known = profile.official_names(called)
    if len(own) != len(called) or (known is not None and known != tuple(own)):
        raise ValueError(
            f"robot {profile.name!r} has the joints {', '.join(own)}; the model has {', '.join(called)}: "
            "both need the same joints in the same order"
        )


MEMBER_LIMITS: Mapping[str, int] = {
    archive.EXPORT: 64 * 1024,
    archive.CHECKSUMS: 64 * 1024,
    MANIFEST: DEFAULT_LIMITS.manifest_bytes,
    TENSORS: 1 << 30,
    ROBOT: DEFAULT_LIMITS.robot_bytes,
}


def find_model(given: str, url: str) -> TorqueModel:
    """Load a model from a folder, or fetch it by name from the service at `url`.

    Raise ModelFormatError for an invalid model, ApiError or ServiceUnreachableError if the service cannot provide it.
    """
    folder = Path(given)
    if (folder / MANIFEST).is_file():
        return lipcore.load(folder)
    if folder.is_dir():
        raise ModelFormatError(f"{given} has no {MANIFEST}: it is not the folder of a saved model", MANIFEST)
    return fetch(given, url)


def fetch(name: str, url: str) -> TorqueModel:
    """Return a served model in its present state, including what it learnt online."""
    with TemporaryDirectory(prefix="lipserve-excite-") as folder, Client(url) as client:
        path = client.export(name, Path(folder) / "model.tar")
        try:
            files = archive.members(path, MEMBER_LIMITS)
        except archive.ArchiveError as error:
            raise ModelFormatError(str(error), error.member) from None
        for each in (archive.EXPORT, archive.CHECKSUMS):
            files.pop(each, None)
        return persistence.decode(files)


app = alone()
ERRORS = (ApiError, NotPositiveDefiniteError)
"""Errors that are printed without a traceback, beside ValueError and OSError."""
RANDOM_MOTIONS = 5
"""Number of random motions that the planned motion is compared with."""
WARNING = (
    "The plan respects joint limits only. It does not check for obstacles or self-collisions: run it in a simulator or "
    "at low speed first."
)


@dataclass(frozen=True)
class Random:
    """Share of variance that the paper's random sinusoids would leave, mean over draws: (n,) each."""

    slow: Array
    fast: Array


@app.command()
def excite(
    out: Annotated[Path, typer.Option(help="CSV file to write, with columns t, q1…, dq1…, ddq1….", dir_okay=False)],
    model: Annotated[
        str | None, typer.Option(help="Model to improve: the folder of a saved model, or the name of a served one.")
    ] = None,
    robot: Annotated[
        str | None,
        typer.Option(help=f"A .urdf file or one of {', '.join(names())}. Default: the robot with the model's joints."),
    ] = None,
    seconds: Annotated[float, typer.Option(help="Duration of the motion, s.")] = 50.0,
    rate: Annotated[float, typer.Option(help="Sample rate, Hz.")] = 100.0,
    position: Annotated[float, typer.Option("--range", help="Max share of each joint's range to use.")] = 0.95,
    reach: Annotated[float | None, typer.Option(help="Max distance from the middle of the range, rad or m.")] = None,
    scale: Annotated[float, typer.Option(help="Max share of the speed, acceleration and torque limits to use.")] = 0.9,
    noise: Annotated[
        float | None,
        typer.Option(help="Std of the torque noise, N·m, if there is no model. Default: 1 % of the torque's std."),
    ] = None,
    estimator: Annotated[
        str, typer.Option(help=f"Estimator to plan for without a model: one of {', '.join(ESTIMATORS)}.")
    ] = "rigid-body",
    harmonics: Annotated[
        int | None, typer.Option(min=2, help="Harmonics of the Fourier series. Default: as many as the limits allow.")
    ] = None,
    iterations: Annotated[int, typer.Option(min=0, help="Iterations of the search.")] = PlanOptions.iterations,
    budget: Annotated[float, typer.Option(help="Max duration of the search, s.")] = PlanOptions.budget_s,
    seed: Annotated[
        int, typer.Option(min=0, help="Random seed. Equal seeds give equal motions if the budget suffices.")
    ] = 0,
    plot: Annotated[Path | None, typer.Option(dir_okay=False, help="Also plot the motion, .png or .svg.")] = None,
    url: Annotated[str, typer.Option("--url", envvar=URL_VARIABLE, help="Address of the service.")] = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Plan the motion, within a robot's limits, that reduces its model's uncertainty most."""
    if plot is not None:
        plotting.pyplot()  # fail before a minute of planning
    known = None if model is None else find_model(model, url)
    arm = find(robot, known)
    limits = arm.limits.within(position, scale, reach)
    options = PlanOptions(seconds, rate, harmonics, iterations, budget_s=budget, seed=seed)
    belief = Belief.of_model(known) if known is not None else _prior(arm, limits, noise, estimator, seed)

    console = Console(width=None if sys.stdout.isatty() else 120)
    with (err if as_json else console).status("planning") as status:
        made = plan(
            belief,
            limits,
            options,
            arm.robot,
            lambda step, left: status.update(f"planning, step {step}: remaining variance {percent(left, 2)}"),
        )
    write(out, made)
    if plot is not None:
        plotting.draw_motion(plot, made)
    random = random_motion(made)
    if as_json:
        print_json(document(made, random, out, plot))
        return
    console.print(table(made, random), highlight=False)
    console.print(summary(made, "the model" if known is not None else f"a {estimator} prior"), highlight=False)
    for path in filter(None, (out, plot)):
        console.print(f"wrote {path}", highlight=False)
    console.print(WARNING, style="yellow", highlight=False)


def write(path: Path, made: Plan) -> None:
    """Write the motion as CSV in SI units: t, q1 … qn, dq1 … dqn, ddq1 … ddqn, in the order of the joints."""
    t, *parts = made.table()
    joints = range(1, made.limits.n_joints + 1)
    header = ["t", *(f"{name}{joint}" for name in ("q", "dq", "ddq") for joint in joints)]
    np.savetxt(path, np.column_stack([t, *parts]), fmt="%.12g", delimiter=",", header=",".join(header), comments="")


def random_motion(made: Plan) -> Random:
    """Return the variance left by the paper's random sinusoids of the same length, range and speed limits."""
    limits, options = made.limits, made.options
    kinds: list[JointType] = ["revolute"] * limits.n_joints  # has no effect here
    bare = Robot("", None, limits.joint_names, tuple(kinds), limits.lower, limits.upper, limits.speed)
    samples = min(options.samples, 500)
    t = np.arange(samples) * options.seconds / samples
    repeats = options.samples / samples

    def left(speed: float) -> Array:
        stream = Simulation(motion="full", speed=speed)
        draws = (sinusoids(bare, stream, t, np.random.default_rng([options.seed, k])) for k in range(RANDOM_MOTIONS))
        return np.asarray(np.mean([made.left_by(*motion, repeats) for motion in draws], axis=0))

    return Random(left(1.0), left(FAST_SPEED))


def document(made: Plan, random: Random, out: Path, plot: Path | None) -> dict[str, Any]:
    """Return the plan for JSON: expected share of remaining variance and share of the limits used, per joint."""
    start = made.series.at(np.zeros(1))[0][0]
    return {
        "files": [each for each in (out, plot) if each is not None],
        "seconds": made.options.seconds,
        "rate_hz": made.options.rate,
        "harmonics": made.series.harmonics,
        "iterations": made.iterations,
        "out_of_time": made.out_of_time,
        "joint_names": list(made.limits.joint_names),
        "start_q": start,
        "left": made.left,
        "left_by_random": random.slow,
        "left_by_random_fast": random.fast,
        "used": dict(zip(("position", "speed", "acceleration", "torque"), made.used, strict=True)),
        "warnings": [WARNING],
    }


def table(made: Plan, random: Random) -> Table:
    """Return a table of the expected remaining variance and the limits used, one row per joint."""
    grid = Table(title="expected remaining share of the torque variance, and share of the limits used")
    columns = ("planned", "random", "random, fast", "position", "speed", "acceleration", "torque")
    grid.add_column("joint")
    for heading in columns:
        grid.add_column(heading, justify="right")
    rows = zip(made.limits.joint_names, made.left, random.slow, random.fast, made.used.T, strict=True)
    for joint, *left, used in rows:
        grid.add_row(joint, *(percent(share, 2) for share in left), *("-" if np.isnan(u) else percent(u) for u in used))
    means = [percent(np.exp(np.log(each).mean()), 2) for each in (made.left, random.slow, random.fast)]
    grid.add_section()
    grid.add_row("geometric mean", *means, "", "", "", "")
    return grid


def summary(made: Plan, known: str) -> str:
    """Describe the plan: its purpose, the search, and the start position."""
    start = ", ".join(f"{value:.3f}" for value in made.series.at(np.zeros(1))[0][0])
    options = made.options
    ended = f"{counted(made.iterations, 'iteration')} in {made.seconds:.0f} s"
    if made.out_of_time:
        ended += ", stopped by --budget"
    return (
        f"{options.seconds:g} s at {options.rate:g} Hz, {made.series.harmonics} harmonics, planned for {known}; "
        f"{ended}. Random: mean of {RANDOM_MOTIONS} draws of the paper's sums of 50 sinusoids. Random, fast: the same "
        f"sums at {FAST_SPEED:g} times their frequencies. The motion starts and ends at rest at q = {start}."
    )


def _prior(arm: Arm, limits: Limits, noise: float | None, estimator: str, seed: int) -> Belief:
    if arm.robot is None:
        raise ValueError(
            f"no URDF of robot {arm.name!r} is installed, so its torques are unknown: set --model, or set --robot to a "
            ".urdf file"
        )
    bodies = arm.bodies if estimator.startswith("rigid-body") else None
    return Belief.prior(arm.robot, limits, noise, estimator, bodies, seed)
