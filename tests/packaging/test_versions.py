"""The version, and the supported Pythons, are the same in all files."""

import re
import tomllib

import pytest
import yaml

from lipserve import __version__
from tests.docs.blocks import ROOT

PROJECTS = {
    name: tomllib.loads((ROOT / name).read_text("utf-8"))["project"]
    for name in ("pyproject.toml", "clients/python/pyproject.toml")
}
MINOR = ".".join(__version__.split(".")[:2])
NEXT = f"{__version__.split('.')[0]}.{int(__version__.split('.')[1]) + 1}"


def text(path: str) -> str:
    """Return the text of a file of the repository."""
    return (ROOT / path).read_text("utf-8")


@pytest.mark.parametrize(
    ("path", "pattern"),
    [
        ("CHANGELOG.md", r"\A# Changelog\n\n## Unreleased\n(?:[^#].*\n|\n)*## (\S+) - \d{4}-\d\d-\d\d\n"),
        ("clients/cpp/CMakeLists.txt", r"^project\(lipserve-client VERSION (\S+)"),
        *(
            (f"deploy/kubernetes/{kind}/kustomization.yaml", r"newTag: ([^\s}]+)")
            for kind in ("single", "shared", "gpu", "kserve")
        ),
    ],
)
def test_files_have_this_version(path, pattern):
    assert set(re.findall(pattern, text(path), re.MULTILINE)) == {__version__}


def test_service_requires_the_client_of_its_minor_version():
    assert f"lipserve-client>={MINOR},<{NEXT}" in PROJECTS["pyproject.toml"]["dependencies"]
    assert all(each["dynamic"] == ["version"] for each in PROJECTS.values())


@pytest.mark.parametrize("name", PROJECTS)
def test_supported_pythons_are_those_of_the_workflow(name):
    tested = yaml.safe_load(text(".github/workflows/tests.yml"))["jobs"]["test"]["strategy"]["matrix"]["python"]
    prefix = "Programming Language :: Python :: "
    supported = [each.removeprefix(prefix) for each in PROJECTS[name]["classifiers"] if each.startswith(prefix + "3.")]
    assert supported == tested
    assert PROJECTS[name]["requires-python"] == f">={tested[0]}"
