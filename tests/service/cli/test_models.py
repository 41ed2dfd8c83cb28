"""`lipserve models`: versions, aliases, archives."""

from types import SimpleNamespace

import pytest

from lipcore.robots.urdf import describe
from lipserve.records.models import Selection, SelectionCandidate, SelectionHeldOut
from service.cli.versions import print_of_joints, print_selection
from tests.service.cli.conftest import lacking
from tests.service.models.versions import JOINTS, WARNING


def test_models_are_listed_and_shown(run_command, arm):
    name, _ = arm
    assert name in [each["name"] for each in run_command("models", "list", "--json")]
    assert name in run_command("models", "list")
    assert len(run_command("models", "list", "--limit", 1, "--json")) == 1
    shown = run_command("models", "show", name, "--json")
    assert shown["model"]["latest_version"] >= 2
    assert shown["version"]["version"] == shown["model"]["serving_version"]
    text = run_command("models", "show", f"{name}@1")
    assert "version 1: se, 2 joints: joint1, joint2" in text
    assert "not judged: No samples were held out of its training" in text


def test_promotion_can_be_rolled_back(run_command, arm):
    name, _ = arm
    promote = ("models", "promote", name)
    assert run_command(*promote, 1, "--json")["version"] == 1
    assert f"serving → {name} version 2" in run_command(*promote, 2)
    assert run_command("models", "rollback", name, "--json")["version"] == 1
    assert "2 → 1 (rolled back)" in run_command("models", "show", name)
    run_command(*promote, 2)
    assert "version 1" in run_command(*promote, 1, "--alias", "night")
    assert run_command(*promote, "night", "--alias", "day", "--json")["version"] == 1
    assert run_command("predict", f"{name}@day", "--q", "0.1,0.2", "--json")["version"] == 1
    assert run_command("predict", f"{name}@1", "--q", "0.1,0.2", "--json")["version"] == 1
    assert "version 1: " in run_command("models", "show", f"{name}@day")
    assert f"day → {name} version 1" in run_command("models", "alias", name, "day")
    run_command("models", "alias", name, "day", 2)
    assert run_command("models", "alias", name, "day", "--json")["version"] == 2
    run_command("models", "alias", name, "day", "--remove")


def test_versions_have_notes_and_tags(run_command, run_rejected_command, arm):
    name, note = f"{arm[0]}@1", "[red]old gripper[/red]"
    assert "version 1: no note; no tags" in run_command("models", "note", name)
    assert f"version 1: {note}; tags: line 2, ros" in run_command(
        "models", "note", name, note, "--tag", "line 2", "--tag", "ros"
    )
    assert run_command("models", "note", name, "--tag", "ros", "--json") == {"note": note, "tags": ["ros"]}
    shown = run_command("models", "show", name, "--json")
    assert (shown["version"]["note"], shown["model"]["versions"][0]["tags"]) == (note, ["ros"])
    assert "note and tags" in run_command("models", "show", name)
    assert run_command("models", "note", name, "", "--tag", "", "--json") == {"note": None, "tags": []}
    assert "note and tags" not in run_command("models", "show", name)
    assert "at most 500 characters" in run_rejected_command("models", "note", name, "a" * 501)


def test_versions_are_compared(run_command, arm):
    name, dataset = arm
    compared = run_command("models", "compare", name, dataset, 1, 2, "--json")
    assert [each["version"] for each in compared["versions"]] == [1, 2]
    text = run_command("models", "compare", name, dataset, 1, 2)
    assert compared["verdict"] in text
    assert "warning: " in text  # both were trained on it


def test_archive_is_exported_imported_and_deleted(run_command, arm, run_rejected_command, tmp_path):
    name, path = arm[0], tmp_path / "arm.tar"
    assert run_command("models", "export", f"{name}@1", path, "--json")["bytes"] == path.stat().st_size
    made = run_command("models", "import", path, "--name", "cli-imported", "--json")
    assert (made["model"], made["version"]) == ("cli-imported", 1)
    delete = ("models", "delete", "cli-imported")
    assert "permanently?" in run_rejected_command(*delete)  # nobody has answered the question
    run_command(*delete, "--yes")
    assert "no model 'cli-imported'" in run_rejected_command("models", "show", "cli-imported")


def test_version_is_exported_as_c(run_command, run_rejected_command, arm, robot_arm, tmp_path):
    folder, export = tmp_path / "made" / "c", ("models", "export", robot_arm)
    written = run_command(*export, folder, "--format", "c", "--json")
    assert (written["path"], written["format"]) == (str(folder), "c")
    assert sorted(each.name for each in folder.iterdir()) == ["lipserve_model.c", "lipserve_model.h"]
    assert f'#define LIPSERVE_MODEL "{robot_arm}"' in (folder / "lipserve_model.h").read_text()
    assert "cc -O2 -c" in run_command(*export, folder, "--format", "c")
    message = run_rejected_command("models", "export", f"{arm[0]}@1", tmp_path / "none", "--format", "c")
    assert "estimator is 'se', expected one of rigid-body" in message
    assert not (tmp_path / "none").exists()


def test_estimated_arm_is_shown(run_command, run_rejected_command, robot_arm, tmp_path):
    parts = ("joint frames", "rotor kg·m²", "mass, first moment", "shift 2", "mirror image", "-0.05 ± 0.01")
    text = run_command("models", "show", f"{robot_arm}@1")
    assert lacking(text, f"warning: {WARNING}", *parts) == []
    assert "mirror image" not in run_command("models", "show", robot_arm)
    urdf = ("--format", "urdf")
    assert "arm.urdf: " in run_command("models", "export", f"{robot_arm}@1", tmp_path / "arm.urdf", *urdf)
    assert describe((tmp_path / "arm.urdf").read_text()).joint_names == JOINTS
    assert "has no rigid bodies" in run_rejected_command("models", "export", robot_arm, tmp_path / "no.urdf", *urdf)
    assert not (tmp_path / "no.urdf").exists()


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (("models", "show", "cli-arm@99"), "`lipserve models show MODEL` shows the versions"),
        (("models", "alias", "cli-arm", "noon"), "`lipserve models alias cli-arm noon VERSION` creates it"),
        (("evaluate", "cli-arm", "ds_none"), "`lipserve data list` shows the data sets"),
        (("evaluate", "cli-arm", "nowhere.csv"), "`lipserve data list` shows the data sets"),
        (("jobs", "show", "job_none"), "`lipserve jobs list` shows the jobs"),
        (("stream", "nobody", "--simulate", "double-pendulum"), "existing models: "),
        (("stream", "cli-arm"), "`lipserve stream cli-arm --simulate panda`"),
    ],
)
def test_errors_have_hints(run_rejected_command, arm, arguments, hint):
    assert f"hint: {hint}" in run_rejected_command(*arguments)


def judged(estimator, nmse, **given):
    figures = {"log_density": 1.5, "difference": -0.25, "standard_error": 0.1, "coverage": [0.9, None], "seconds": 2.0}
    return SelectionCandidate(estimator=estimator, nmse=nmse, **{**figures, "error": None, **given})


def test_estimator_selection_is_printed(capsys):
    failed = judged("lip-chain", None, log_density=None, error="no [factor]")
    best = judged("rigid-body", [0.01, 0.03], difference=0.0, standard_error=None, edge_nmse=[0.05, 0.09])
    held = SelectionHeldOut(rows=90, blocks=6, repeats=True, edge_rows=30, edge_blocks=2)
    made = {"asked": "auto", "chosen": "rigid-body", "reason": "it errs least", "held_out": held}
    print_selection(Selection(**made, table=[best, judged("rigid-body+lip-chain", None)]))
    parts = ("6 held-out blocks", "2 at the edge", "rigid-body (selected)", "2.00e-02", "7.00e-02", "90.0 %")
    parts += ("0.25 ± 0.10", "it errs least", "figures are too optimistic")
    assert lacking(capsys.readouterr().out, *parts) == []
    nothing = SelectionHeldOut(rows=0, blocks=0, repeats=False)
    print_selection(Selection(**{**made, "held_out": nothing}, table=[failed]))
    out = capsys.readouterr().out
    assert ("optimistic" in out, lacking(out, "not evaluated", "failed: no [factor]")) == (False, [])


def test_fit_report_of_each_joint_is_printed(capsys):
    fit = {"right_angle_2": 0.25, "right_angle_10": 1.0, "local_2": 0.131, "iterations": 9}
    print_of_joints(SimpleNamespace(joint_names=[f"j{number}" for number in range(1, 11)], fit=fit))
    said = capsys.readouterr().out
    angle = "probability that the axis is at a right angle: j2 0.25, j10 1"
    assert lacking(said, angle, "remaining squared error after local correction: j2 0.13") == []
    assert "interval width" not in said
