"""Compile exported C and call it."""

import ctypes
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from lipcore.export.c_writer import SOURCE
from lipcore.model.body import Body

FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2")
needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler, cc, which is not installed")


def run(folder: Path, *command: str) -> str:
    """Run a command in a folder and return its output."""
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def write_files(files: dict[str, str], folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    for name, text in files.items():
        (folder / name).write_text(text, encoding="ascii")


def compile_library(files: dict[str, str], folder: Path, *more: str) -> Path:
    """Compile the source as a shared library, without warnings."""
    write_files(files, folder)
    run(folder, "cc", *FLAGS, *more, "-shared", "-fPIC", SOURCE, "-o", "model.so", "-lm")
    return folder / "model.so"


class Payload(ctypes.Structure):
    _fields_ = [("mass", ctypes.c_double), ("com", ctypes.c_double * 3), ("inertia", ctypes.c_double * 9)]


def c_payload(body: Body) -> Payload:
    inertia = np.zeros((3, 3)) if body.inertia is None else body.inertia
    return Payload(body.mass, (ctypes.c_double * 3)(*body.com), (ctypes.c_double * 9)(*inertia.ravel()))


def c_array(row: np.ndarray) -> ctypes.Array:
    return (ctypes.c_double * len(row)).from_buffer(row)


def evaluate_library(path: Path, motion: np.ndarray, body: Body | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation of motions (3, N, n), and check the function of the mean alone."""
    library, motion = ctypes.CDLL(str(path)), np.ascontiguousarray(motion)
    tau, alone, std = (np.full_like(motion[0], np.nan) for _ in range(3))
    carried = None if body is None else ctypes.byref(c_payload(body))
    for k in range(motion.shape[1]):
        query = [c_array(part[k]) for part in motion]
        if body is None:
            library.lipserve_torque(*query, c_array(alone[k]))
            library.lipserve_torque_std(*query, c_array(tau[k]), c_array(std[k]))
        else:
            library.lipserve_torque_payload(*query, carried, c_array(alone[k]))
            library.lipserve_torque_std_payload(*query, carried, c_array(tau[k]), c_array(std[k]))
    np.testing.assert_array_equal(alone, tau)
    return tau, std
