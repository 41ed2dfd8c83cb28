"""Tests of exported C as code: self-test, compilers, symbols, names, the example controller."""

import ctypes
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lipcore import FitOptions, TorqueModel, load, train
from lipcore.export.c_weights import UnsupportedEstimatorError
from lipcore.export.c_writer import HEADER, SOURCE, c_files
from lipcore.export.origin import ModelOrigin
from tests import ROOT
from tests.choosing import slow
from tests.clients.cpp.building import sanitizers
from tests.lipcore.arm_oracles import (
    arm,
    record_motion,
)
from tests.lipcore.export.compiled import (
    FLAGS,
    compile_library,
    needs_compiler,
    run,
    write_files,
)
from tests.lipcore.export.models import (
    MODELS,
    ORIGIN,
    PANDA,
    train_arm,
    train_with_alternatives,
    train_with_alternatives_and_drive,
    train_with_energies,
)


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(
    ("name", "between", "change"),
    [
        ("panda", ("double DRIVE", "double MISFIT"), 1e-5),
        ("panda", ("void write_torque", "void write_features"), 1e-5),
        ("panda", ("void write_features", "void read_payload"), 1e-2),
        ("energies of a prismatic joint", ("double CONSTANT", "int PLACE"), 1e-5),
    ],
)
def test_self_test_detects_a_changed_number(name: str, between: tuple[str, str], change: float, tmp_path: Path) -> None:
    files = c_files(MODELS[name](), ORIGIN)
    text = files[SOURCE]
    first, last = map(text.index, between)
    found = [each.span() for each in re.compile(r"-?\d+\.\d{12,}(e-?\d+)?").finditer(text, first, last)]
    large = [span for span in found if abs(float(text[slice(*span)])) > 0.05]
    for start, end in np.random.default_rng(0).choice(large, 8, replace=False):
        wrong = repr(float(text[start:end]) * (1 + change))
        path = compile_library({**files, SOURCE: text[:start] + wrong + text[end:]}, tmp_path / str(start))
        assert ctypes.CDLL(str(path)).lipserve_selftest() > 0, text[start:end]


@pytest.mark.slow
@needs_compiler
def test_self_test_detects_a_changed_state(tmp_path: Path) -> None:
    files = c_files(MODELS["friction of all kinds"](), ORIGIN)
    text = files[SOURCE]
    changes = {
        "lower[e][k] + step": "lower[e][k] - step",
        "upper[e][k] + step": "upper[e][k]",
        "0.5 * (state->lower": "0.501 * (state->lower",
        "0.001, 0.001, 0.001}": "0.001, 0.00101, 0.001}",
    }
    for k, (right, wrong) in enumerate(changes.items()):
        assert right in text
        path = compile_library({**files, SOURCE: text.replace(right, wrong, 1)}, tmp_path / str(k))
        assert ctypes.CDLL(str(path)).lipserve_selftest() > 0, wrong


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(
    "make",
    [train_with_alternatives, lambda: train_with_energies("RPR", 51), train_with_alternatives_and_drive],
    ids=["alternatives", "energies", "friction"],
)
def test_code_has_no_mutable_state(make: Callable[[], TorqueModel], tmp_path: Path) -> None:
    """The object has no writable data and calls only five functions of libm."""
    write_files(c_files(make(), ORIGIN), tmp_path)
    run(tmp_path, "cc", *FLAGS, "-c", SOURCE, "-o", "model.o")
    kinds = {line.split()[-1]: line.split()[-2] for line in run(tmp_path, "nm", "model.o").splitlines()}
    called = {name for name, kind in kinds.items() if kind == "U"}
    by_compilers = {"memcpy", "memmove", "memset", "sincos", "_GLOBAL_OFFSET_TABLE_", "__stack_chk_fail"}
    assert called - by_compilers <= {"sin", "cos", "sqrt", "exp", "tanh"}
    assert set(kinds.values()) <= set("TtRrU"), kinds


MAIN = '#include "lipserve_model.h"\nint main(void) { return lipserve_selftest(); }\n'


@pytest.mark.slow
@pytest.mark.parametrize("compiler", ["gcc", slow("clang")])
@pytest.mark.parametrize(
    "name",
    ["panda", *map(slow, ("alternatives", "friction of all kinds, alternatives", "energies of a prismatic joint"))],
)
def test_compilers_and_sanitizers_report_nothing(name: str, compiler: str, tmp_path: Path) -> None:
    if shutil.which(compiler) is None:
        pytest.skip(f"needs {compiler}, which is not installed")
    write_files({"main.c": MAIN, **c_files(MODELS[name](), ORIGIN)}, tmp_path)
    sanitized = sanitizers(compiler)
    for more in ((), (*sanitized, "-O1")) if sanitized else ((),):
        run(tmp_path, compiler, *FLAGS, *more, "main.c", SOURCE, "-o", "main", "-lm")
        run(tmp_path, "./main")


@pytest.mark.slow
def test_names_cannot_end_comments_or_strings(tmp_path: Path) -> None:
    names = ("*/ int x; /*", '", 0}; int y; //', "gelenk ü\\\n?/")
    model = replace(train_arm("RRR", 50), joint_names=names)
    files = c_files(model, ModelOrigin('*/"\\', 1, 0, "*/"))
    assert all(text.isascii() for text in files.values())
    code = re.sub(r'/\*.*?\*/|"(\\.|[^"\\\n])*"', "", files[HEADER] + files[SOURCE], flags=re.DOTALL)
    assert "int x" not in code
    assert "int y" not in code
    if shutil.which("cc") is None:
        return
    library = ctypes.CDLL(str(compile_library(files, tmp_path)))
    size = max(len(name.encode()) for name in names) + 1
    stored = (ctypes.c_char * (3 * size)).in_dll(library, "lipserve_joint_names").raw
    assert [stored[k * size : (k + 1) * size].rstrip(b"\0").decode() for k in range(3)] == list(names)


def test_other_estimators_are_rejected() -> None:
    _, _, robot = arm("RRR", 50)
    few = FitOptions(device="cpu", hyperparameter_samples=20, max_iterations=2, starts=1)
    model = train(record_motion(robot, 1, 40), robot.joint_types, "lip-chain", few)
    with pytest.raises(
        UnsupportedEstimatorError, match=r"'lip-chain', expected one of rigid-body, .*rigid-body\+lip-chain for C"
    ):
        c_files(model, ORIGIN)


@pytest.mark.slow
@needs_compiler
@pytest.mark.skipif(shutil.which("c++") is None, reason="needs a C++ compiler, c++, which is not installed")
def test_example_controller_uses_the_code(tmp_path: Path) -> None:
    model = load(PANDA)
    write_files(c_files(model, ORIGIN), tmp_path)
    run(tmp_path, "cc", *FLAGS, "-c", SOURCE)
    strict = ("-std=c++17", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2", "-I.")
    example = ROOT / "docs/examples/feedforward_controller.cpp"
    run(tmp_path, "c++", *strict, str(example), "lipserve_model.o", "-o", "controller")
    limits = np.array([model.training_range["q"][end] for end in ("min", "max")])
    for middle, used in ((limits.mean(0), 20), (limits[1] + 1.0, 0)):
        printed = run(tmp_path, "./controller", "20", *map(str, middle))
        assert printed.startswith(f"used {used} of 20, the longest cycle took")
