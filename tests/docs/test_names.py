"""Names in backticks, in docstrings and documents, exist in the code."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.foundation.settings import Settings
from tests import ROOT

CODE = ("lipcore", "service", "clients", "benchmarks")
DOCUMENTS = (*sorted((ROOT / "docs").glob("*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md")
NAME = re.compile(r"(?<!`)`([A-Za-z_][A-Za-z0-9_]*(?:\.[A-Za-z_][A-Za-z0-9_]*)*)(?:\(\))?`(?!`)")
WORD = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
FILES = (".js", ".toml", ".in", ".hpp", ".cpp", ".yaml", ".yml", ".sh", ".txt")
"""Suffixes of other files that define names."""
COLUMNS = {"tau_J", "J", "actual_q", "pos_deg", "vel_rad_s", "left_panda_joint", "ur5e_elbow_joint", "current_position"}
COLUMNS |= {"q1_deg", "dq1_deg_per_s"}
"""Example names of columns and joints in recordings."""
FOREIGN = {"syrk", "max_body_size", "armature", "OTEL_TRACES_SAMPLER", "sarcos_test", "npz", "NOTIFY", "pg_amcheck"}
FOREIGN |= {"DASK_DISTRIBUTED__COMM__TLS__CA_FILE"}
"""Names of LAPACK, FastAPI, MuJoCo, OpenTelemetry, PostgreSQL, Dask and a file of others."""


def sources(*folders: str, ends: tuple[str, ...] = (".py",)) -> Iterator[Path]:
    for folder in folders:
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix in ends and not {"site", "bundles", "__pycache__"} & set(path.parts):
                yield path


def words_of(tree: ast.AST) -> Iterator[str]:
    """Yield the words of names and strings of code, without its docstrings."""
    docstrings = {id(each.value) for each in ast.walk(tree) if is_text(each)}
    for node in ast.walk(tree):
        if id(node) not in docstrings:
            for value in vars(node).values():
                for text in value if isinstance(value, list) else [value]:
                    if isinstance(text, str):
                        yield from WORD.findall(text)


def is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def texts(tree: ast.AST) -> Iterator[str]:
    """Yield all docstrings, including those of attributes."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        yield from (each.value.value for each in body if is_text(each)) if isinstance(body, list) else ()


@pytest.fixture(scope="module")
def known() -> set[str]:
    """Return every word of the code, with strings, without docstrings and comments; and of files that the code
    reads."""
    words = {path.stem for path in sources(*CODE, "docs", "tests")} | {path.name for path in ROOT.iterdir()}
    for path in sources(*CODE, "docs"):
        words.update(words_of(ast.parse(path.read_text("utf-8"))))
    for path in [*sources(*CODE, "deploy", "docs", ends=FILES), *sources("tests")]:
        words |= set(WORD.findall(path.read_text("utf-8")))
    for name in ("pyproject.toml", "Makefile", "Dockerfile", "compose.yaml"):
        words |= set(WORD.findall((ROOT / name).read_text("utf-8")))
    settings = {f"LIPSERVE_{name.upper()}" for name in Settings.model_fields}
    return words | settings | COLUMNS | FOREIGN


def unknown(text: str, known: set[str]) -> list[str]:
    """Return the names of a text that are not known; `joint_1` counts as known if `joint` is."""
    bare = r"$^", r"\d+$", r"_?\d+$"
    return [
        name
        for name in NAME.findall(text)
        if not any({re.sub(end, "", part) for part in name.split(".")} <= known for end in bare)
    ]


@pytest.mark.parametrize("folder", CODE)
def test_names_in_docstrings_exist(known: set[str], folder: str) -> None:
    found = {
        str(path.relative_to(ROOT)): [
            name for text in texts(ast.parse(path.read_text("utf-8"))) for name in unknown(text, known)
        ]
        for path in sources(folder)
    }
    assert {path: wrong for path, wrong in found.items() if wrong} == {}


def test_names_in_documents_exist(known: set[str]) -> None:
    found = {path.name: wrong for path in DOCUMENTS if (wrong := unknown(path.read_text("utf-8"), known))}
    assert found == {}
