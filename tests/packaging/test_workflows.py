"""The workflows of GitHub: their commands exist, and their files are valid."""

import importlib.util
import re
import subprocess
import sys

import pytest
import yaml

from tests.docs.blocks import ROOT

WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yml"))
TARGETS = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE))
SCHEMAS = {
    "vendor.github-workflows": WORKFLOWS,
    "vendor.dependabot": [ROOT / ".github/dependabot.yml"],
    "vendor.github-issue-forms": sorted((ROOT / ".github/ISSUE_TEMPLATE").glob("*.yml")),
}


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_commands_of_workflows_are_make_targets_or_files(path):
    jobs = yaml.safe_load(path.read_text("utf-8"))["jobs"]
    lines = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    assert lines or all("uses" in step for job in jobs.values() for step in job["steps"])
    for line in lines:
        program, *words = line.split()
        if program == "make":
            assert words, line
            assert set(words) <= TARGETS, line
        else:
            assert not words, line
            assert (ROOT / program).is_file(), line
    for job in jobs.values():
        needed = job.get("needs", [])
        assert ({needed} if isinstance(needed, str) else set(needed)) <= jobs.keys()


def test_pre_commit_hooks_include_make_lint():
    repositories = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text("utf-8"))["repos"]
    hooks = [hook for each in repositories for hook in each["hooks"]]
    assert {"trailing-whitespace", "end-of-file-fixer", "check-yaml"} <= {hook["id"] for hook in hooks}
    (local,) = (hook for hook in hooks if "entry" in hook)
    assert local["entry"] == "make lint"


@pytest.mark.slow
@pytest.mark.parametrize("schema", SCHEMAS)
@pytest.mark.skipif(importlib.util.find_spec("check_jsonschema") is None, reason="needs check-jsonschema")
def test_files_of_github_are_valid(schema):
    assert SCHEMAS[schema]
    command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", schema, *map(str, SCHEMAS[schema])]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
