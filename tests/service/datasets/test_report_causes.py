"""What ruins a model: each defect, made in a recording of a simulated arm, is named, and its options mend the upload.

The arms are others than those that the thresholds were set on, see causes.py.
"""

import re
import sys
import tempfile
from collections import Counter
from functools import cache
from pathlib import Path

import numpy as np
import pinocchio
import pytest

from lipcore import profiles
from lipcore.robots.dirt import Dirt
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import FAST_SPEED, Simulation, inverse_dynamics, simulate
from service.contract.datasets import DatasetReport
from service.contract.uploads import UploadQuery
from service.datasets.formats.opening import open_table
from service.datasets.mapping.reading import read
from service.datasets.options import upload_options
from service.datasets.report.causes import TorqueWork
from service.datasets.report.making import make_report
from service.datasets.staging import prepare
from service.foundation.settings import Settings
from service.storage.disk import Disk
from tests.choosing import few
from tests.service.datasets.mapping_tables import canonical
from tests.service.datasets.report_data import report_on

ARMS = ("ur10", "talos-left", "ur3", "xarm7", "tiago-pro-left", "pr2-left", "so100", "baxter-right", "tiago")
COURSES = (("sinusoids", FAST_SPEED), ("periodic", 1.0), ("rests", 1.0))
RECORDINGS = [(arm, *COURSES[place % 3], dirty) for place, arm in enumerate(ARMS) for dirty in (False, True)]
QUICK = ("talos-left", "periodic", 1.0, True)


def listed(options: dict[str, str]) -> str:
    return " ".join(f"{name}={value}" for name, value in options.items())


@cache
def recording(arm: str, course: str, speed: float, dirty: bool, seconds: float = 40.0) -> dict[str, np.ndarray]:
    friction = {"dirt": Dirt(seed=len(arm))} if dirty else {"viscous": 0.2, "coulomb": 0.3}
    stream = Simulation(n_samples=int(100 * seconds), rate=100, course=course, speed=speed, **friction)
    made = simulate(load_robot(arm), stream, seed=200 + len(arm))
    return {"t": made.t, "q": made.q, "dq": made.dq, "tau": made.tau}


def gravity(arm: str, q: np.ndarray) -> np.ndarray:
    return inverse_dynamics(load_robot(arm), q, np.zeros_like(q), np.zeros_like(q))


def upload(folder: Path, columns: dict[str, np.ndarray], /, **query: str) -> DatasetReport:
    """The report of an upload as CSV, joints numbered, with options of the route's query."""
    folder = Path(tempfile.mkdtemp(dir=folder))
    table = canonical(columns)
    file, settings = folder / "recording.csv", Settings(home=folder)
    np.savetxt(file, np.column_stack([*table.values()]), "%.9g", ",", header=",".join(table), comments="")
    options = upload_options(UploadQuery.model_validate(query))
    robot, disk = profiles.profile(query["robot"]), Disk(settings)
    with open_table(file, "csv", options.read, settings) as opened:
        got = read(opened, folder, options, robot, settings, disk)
    prepared = prepare(got.staged, folder, options.recipe, 30, disk)
    holds = got.torque_convention == "gravity_included"
    made = make_report(got.staged, prepared, robot, got.noted, options.recipe, holds, got.facts)
    return DatasetReport.model_validate(made)


@pytest.mark.slow
@pytest.mark.parametrize("case", few(RECORDINGS, lambda case: case == QUICK))
def test_good_recording_has_no_remedies(case: tuple[str, str, float, bool], tmp_path: Path) -> None:
    columns, arm = recording(*case), profiles.profile(case[0])
    for profile, names in ((arm, arm.joint_names), (None, [f"a{k}" for k in arm.joint_names])):
        report = report_on(tmp_path, tuple(names), columns, profile)
        assert report.remedies == []
        assert [each for each in report.warnings if "its motion" in each or "not synchronised" in each] == []
        assert not any(each.smoothed for each in report.noise)
    without = columns | {"tau": columns["tau"] - gravity(case[0], columns["q"])}
    assert report_on(tmp_path, arm.joint_names, without, arm, gravity=False).remedies == []


def defects(arm: str, columns: dict[str, np.ndarray]) -> dict[str, tuple[dict[str, np.ndarray], dict[str, str]]]:
    """Columns and options of a bad upload by the cause that it has."""
    tau, n = columns["tau"], columns["q"].shape[1]
    swapped = np.arange(n)
    swapped[[1, 2]] = [2, 1]
    by_name = np.argsort(load_robot(arm).joint_names)
    order = by_name if (by_name != np.arange(n)).any() else np.arange(n)[::-1]
    return {
        "torque_sign": (columns | {"tau": -tau}, {}),
        "torque_sign of one": (columns | {"tau": tau * np.where(np.arange(n) == 1, -1, 1)}, {}),
        "no_gravity": (columns | {"tau": tau - gravity(arm, columns["q"])}, {}),
        "gravity_included": (columns, {"torque_convention": "gravity_compensated"}),
        "torque_factor": (columns | {"tau": tau / np.linspace(4.0, 11.0, n)}, {}),
        "torque_order": (columns | {"tau": tau[:, swapped]}, {}),
        "joint_order": ({name: v[:, order] if v.ndim == 2 else v for name, v in columns.items()}, {}),
    }


DEFECTS = ("torque_sign", "torque_sign of one", "no_gravity", "gravity_included")
DEFECTS += ("torque_factor", "torque_order", "joint_order")
QUICKLY = ("torque_sign of one", "no_gravity")


@pytest.mark.parametrize("defect", few(DEFECTS, lambda defect: defect in QUICKLY))
def test_defect_is_named_and_its_options_correct_it(defect: str, tmp_path: Path) -> None:
    columns, options = defects(QUICK[0], recording(*QUICK))[defect]
    query = {"robot": QUICK[0], "effort": "measured", **options}
    report = upload(tmp_path, columns, **query)
    (remedy,) = report.remedies
    assert remedy.cause == defect.split(" of ", maxsplit=1)[0]
    assert remedy.text in report.warnings
    assert f"ead the file again with `{listed(remedy.options)}`" in remedy.text
    mended = upload(tmp_path, columns, **query | remedy.options)
    assert mended.remedies == []


@pytest.mark.slow
@pytest.mark.parametrize("dirty", [False, True])
def test_defects_are_recognised_with_at_most_one_false_cause(dirty: bool, tmp_path: Path) -> None:
    verdicts = Counter()
    for case in (each for each in RECORDINGS if each[-1] == dirty):
        for defect, (columns, options) in defects(case[0], recording(*case)).items():
            arm = profiles.profile(case[0])
            report = report_on(tmp_path, arm.joint_names, columns, arm, gravity=not options)
            causes = [each.cause for each in report.remedies]
            right = {defect.split(" of ")[0], *(["friction_sign"] if defect.startswith("torque_sign") else [])}
            verdict = "missed" if not causes else "named" if set(causes) <= right else "wrong"
            verdicts[verdict] += 1
            if verdict != "named":
                sys.stdout.write(f"{case} {defect} {verdict} {causes}\n")
    assert verdicts["wrong"] <= 1, verdicts
    assert verdicts["named"] >= 0.85 * verdicts.total(), verdicts


@pytest.mark.slow
def test_mounting_on_ceiling_or_wall_is_not_mistaken_for_missing_gravity(tmp_path: Path) -> None:
    columns, arm = recording(*QUICK), profiles.profile(QUICK[0])
    upright = gravity(QUICK[0], columns["q"])
    robot = load_robot(QUICK[0])
    model, data = robot.model.copy(), robot.model.createData()
    model.gravity.linear = np.array([9.81, 0.0, 0.0])
    wall = np.array([pinocchio.computeGeneralizedGravity(model, data, robot.configuration(q)) for q in columns["q"]])
    model.gravity.linear = -9.81 * np.array([0.0, np.sin(np.radians(20)), np.cos(np.radians(20))])
    tilted = np.array([pinocchio.computeGeneralizedGravity(model, data, robot.configuration(q)) for q in columns["q"]])
    for other, words in ((-upright, "hang upside down"), (wall, "on a wall"), (tilted, r"about (19|20|21)° away")):
        mounted = columns | {"tau": columns["tau"] - upright + other}
        (remedy,) = report_on(tmp_path, arm.joint_names, mounted, arm).remedies
        assert (remedy.cause, remedy.options) == ("mounting", None)
        assert re.search(words, remedy.text)


def test_gravity_counted_twice_cannot_be_corrected(tmp_path: Path) -> None:
    columns, arm = recording(*QUICK), profiles.profile(QUICK[0])
    twice = columns | {"tau": columns["tau"] + gravity(QUICK[0], columns["q"])}
    report = report_on(tmp_path, arm.joint_names, twice, arm)
    assert [(each.cause, each.options) for each in report.remedies] == [("gravity_doubled", None)]
    factors = [each.gravity for each in report.against_robot.joints if each.joint in report.remedies[0].joints]
    assert factors == pytest.approx([2.0] * len(factors), abs=0.3)


def test_work_of_the_torques_shows_their_sign_without_a_robot(tmp_path: Path) -> None:
    columns = recording(*QUICK)
    names = tuple(f"a{joint}" for joint in range(columns["q"].shape[1]))
    (remedy,) = report_on(tmp_path, names, columns | {"tau": -columns["tau"]}).remedies
    assert (remedy.cause, remedy.options) == ("torque_sign", {"torque_factors": ",".join(["-1"] * len(names))})


def test_work_that_comes_back_has_no_trend() -> None:
    t = np.arange(4000) / 100
    stored = TorqueWork.of(5 * np.cos(3 * t) - 2 * np.cos(1.1 * t))
    assert abs(stored.trend) < 0.3
    lossy = TorqueWork.of(5 * np.cos(3 * t) - 2.0)
    assert lossy.power == pytest.approx(-2.0, abs=0.1)
    assert lossy.trend < -10


def test_negative_friction_is_implausible(tmp_path: Path) -> None:
    robot = load_robot("finger-edu")
    made = simulate(robot, Simulation(n_samples=3000, rate=100, speed=FAST_SPEED, noise=0.001), seed=5)
    friction = np.array([0.02, -0.02, 0.02]) * made.dq
    columns = {"t": made.t, "q": made.q, "dq": made.dq, "tau": made.tau + friction}
    report = report_on(tmp_path, robot.joint_names, columns, profiles.profile("finger-edu"))
    viscous = [each.viscous for each in report.excitation.joints]
    assert [each.value for each in viscous] == pytest.approx([0.02, -0.02, 0.02], abs=4e-3)
    assert [each.implausible for each in viscous] == [False, True, False]
    (remedy,) = report.remedies
    assert (remedy.cause, remedy.joints) == ("friction_sign", [robot.joint_names[1]])


UR = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")


@pytest.mark.parametrize(
    ("arm", "pattern", "given", "suggested"),
    [
        ("panda", "left_fer_joint{}", None, {"robot": "panda"}),
        ("ur10", "{}_joint", None, {"robot": "ur10", "effort": "measured"}),
        ("ur3", "arm_{}", None, {"robot": "ur3", "effort": "measured"}),
        ("ur10", "{}_joint", "ur3", {"robot": "ur10"}),
    ],
)
def test_names_and_torque_suggest_the_robot(
    arm: str, pattern: str, given: str | None, suggested: dict[str, str], tmp_path: Path
) -> None:
    columns = recording(arm, *COURSES[0], False, 30.0)
    names = tuple(map(pattern.format, range(1, 8) if arm == "panda" else UR))
    about = {"profile": profiles.profile(given)} if given else {"source": {"effort": "measured"}}
    report = report_on(tmp_path, names, columns, **about)
    assert [(each.cause, each.options) for each in report.remedies] == [("robot", suggested)]
    if given is None:
        assert listed(suggested) in " ".join(report.advice)
        assert report.against_robot.robot == arm
        assert report.warnings == []


@pytest.mark.slow
def test_friction_is_judged_beside_the_robot_that_names_suggest(tmp_path: Path) -> None:
    """Without the robot's bodies, no such recording tells a constant torque from gravity."""
    names, columns = tuple(f"fer_joint{joint}" for joint in range(1, 8)), recording("panda", *COURSES[0], False)
    report = report_on(tmp_path, names, columns)
    assert report.excitation.friction_beside == "rigid bodies"
    with_robot = report_on(tmp_path, names, columns, profiles.profile("panda"))
    for term in ("viscous", "coulomb", "offset"):
        judged = [[getattr(each, term) for each in made.excitation.joints] for made in (report, with_robot)]
        assert judged[0] == judged[1]
    assert [each.coulomb.value for each in report.excitation.joints] == pytest.approx([0.3] * 7, abs=0.07)  # low-passed
    assert "friction is estimated beside the rigid bodies of panda, which the joint names match" in report.reading
    assert not any("constant torque" in each for each in report.advice)
    other = report_on(tmp_path, tuple(f"axis{joint}" for joint in range(1, 8)), columns)
    assert other.excitation.friction_beside == "any motion"
    assert any("constant torque" in each for each in other.advice)
    assert "panda, fr3 and xarm7), read the file again with `robot`" in other.advice[0]
    assert not any("No robot is named" in each for each in (*report.advice, *with_robot.advice))


def test_report_advises_on_standstill_and_joints_that_move_together(tmp_path: Path) -> None:
    t = np.arange(3000) / 100
    swing = np.where(t < 10, np.sin(1.5 * t), np.sin(15.0))
    q = swing[:, None] * np.array([1.0, -0.5, 0.3])
    columns = {"t": t, "q": q, "tau": 5 * np.cos(q) + np.random.default_rng(1).normal(0, 0.1, q.shape)}
    report = report_on(tmp_path, ("a", "b", "c"), columns)
    assert report.excitation.standstill == pytest.approx(2 / 3, abs=0.05)
    assert report.excitation.motion_dimensions == pytest.approx(1.0, abs=0.01)
    reply = " ".join(report.advice)
    assert "The robot stands still in 6" in reply
    assert "The joints move together: 3 joints make 1.0 independent motions" in reply


def test_missing_gravity_shows_in_narrow_motion(tmp_path: Path) -> None:
    """Torque by gravity is then nearly constant, and might be an offset."""
    arm, t = profiles.profile("ur5"), np.arange(3000) / 125
    rng = np.random.default_rng(2)
    rate, phase = rng.uniform(2, 6, (3, 6)), rng.uniform(0, 6, (3, 6))
    angle = t[:, None, None] * rate + phase
    q = np.array([0.0, -0.8, 1.2, -0.9, 0.5, 0.2]) + 0.12 * np.sin(angle).sum(1)
    dq, ddq = 0.12 * (rate * np.cos(angle)).sum(1), -0.12 * (rate**2 * np.sin(angle)).sum(1)
    tau = inverse_dynamics(load_robot("ur5"), q, dq, ddq) + 0.5 * dq + 0.05 * rng.standard_normal(q.shape)
    for measured, causes in ((tau, []), (tau - gravity("ur5", q), ["no_gravity"])):
        columns = {"t": t, "q": q, "dq": dq, "tau": measured}
        assert [each.cause for each in report_on(tmp_path, arm.joint_names, columns, arm).remedies] == causes


def test_gravity_that_the_motion_does_not_show_is_reported_as_undetermined(tmp_path: Path) -> None:
    """Of an upright arm only the first and the last joint move, which changes no gravity."""
    t, rng = np.arange(2000) / 50, np.random.default_rng(2)
    q = np.tile([0.0, -np.pi / 2, 0.0, -np.pi / 2, 0.0, 0.0], (2000, 1))
    q[:, 0], q[:, 5] = np.sin(t) + 0.3 * np.sin(7**0.5 * t), 0.7 * np.sin(3**0.5 * t)
    dq = np.gradient(q, t, axis=0)
    tau = inverse_dynamics(load_robot("ur5"), q, dq, np.gradient(dq, t, axis=0)) + 2 * dq
    columns = {"t": t, "q": q, "dq": dq, "tau": tau + 0.05 * rng.standard_normal(q.shape)}
    noted = "undetermined: whether the torque contains gravity"
    names, arm = profiles.profile("ur5").joint_names, profiles.profile("ur5")
    assert any(each.startswith(noted) for each in report_on(tmp_path, names, columns, arm).reading)
    q[:, 1] += 0.6 * np.sin(0.9 * t)
    dq = np.gradient(q, t, axis=0)
    tau = inverse_dynamics(load_robot("ur5"), q, dq, np.gradient(dq, t, axis=0)) + 2 * dq
    columns |= {"q": q, "dq": dq, "tau": tau + 0.05 * rng.standard_normal(q.shape)}
    assert not any(each.startswith(noted) for each in report_on(tmp_path, names, columns, arm).reading)
