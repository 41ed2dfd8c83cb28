"""Builds the recipes of clients/examples against stubs, plays motions to them, and states what they must command."""

import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from lipcore import TorqueModel
from lipcore.data.motion import Motion
from lipcore.export.c_writer import SOURCE, ModelOrigin, c_files
from lipcore.model import dynamics
from tests import ROOT
from tests.clients.cpp.building import sanitizers

EXAMPLES, STUBS = ROOT / "clients/examples", Path(__file__).with_name("stubs")
STRICT = ("-std=c++17", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O1")


def build(model: TorqueModel, folder: Path, *sources: Path) -> Path:
    """Compile a recipe with an exported model, warnings as errors and sanitizers, and return the program."""
    if shutil.which("cc") is None or shutil.which("c++") is None:
        pytest.skip("needs the compilers cc and c++, which are not installed")
    for name, text in c_files(model, ModelOrigin("an-arm", 3, 7, "0123")).items():
        (folder / name).write_text(text, encoding="ascii")
    for command in (
        ["cc", "-std=c99", "-O2", "-c", SOURCE, "-o", "model.o"],
        ["c++", *STRICT, *sanitizers("c++"), f"-I{folder}", f"-I{STUBS}", *sources, "model.o", "-o", "recipe"],
    ):
        made = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert made.returncode == 0, made.stderr
    return folder / "recipe"


@dataclass(frozen=True)
class Played:
    """What a recipe did: commands (N, n) N·m, its exit status and its output."""

    commands: np.ndarray
    status: int
    output: str


def play(program: Path, rows: np.ndarray, *arguments: str, **environment: str) -> Played:
    """Run a recipe while its stub plays these rows."""
    motion, commands = program.with_name("motion.txt"), program.with_name("commands.txt")
    np.savetxt(motion, rows, fmt="%.17g")
    commands.unlink(missing_ok=True)
    paths = {"MOTION": str(motion), "COMMANDS": str(commands)}
    ran = subprocess.run(
        [program, *arguments],
        cwd=program.parent,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **paths, **environment},
    )
    sent = np.loadtxt(commands, ndmin=2) if commands.exists() else np.empty((0, 0))
    return Played(sent, ran.returncode, ran.stdout + ran.stderr)


@dataclass(frozen=True)
class Law:
    """The control law of `torque_loop.hpp`. max_torque to damping: (n,); the others as there."""

    max_torque: np.ndarray
    max_rate: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    adds_gravity: bool = True
    adds_coriolis: bool = False
    ramp_s: float = 2.0

    def commands(
        self, model: TorqueModel, q: np.ndarray, dq: np.ndarray, desired: np.ndarray, dt: np.ndarray, stop: int
    ) -> np.ndarray:
        """Return the commands of N cycles, (N, n).

        q, dq: (N, n); desired: (3, N, n); dt: (N,) s; stop: first cycle with a state that stops it, N if there is none.
        """
        good = np.minimum(np.arange(len(q)), stop - 1)
        q, dq, desired = q[good], dq[good], desired[:, good]
        rest = np.zeros_like(q)
        moving = (
            model.predict(*desired).tau
            - dynamics.components(model, Motion(desired[0], rest, rest), ["gravity"])["gravity"].mean
        )
        if self.adds_coriolis:
            moving -= dynamics.components(model, Motion(*desired), ["coriolis"])["coriolis"].mean
        holding = rest
        if not self.adds_gravity:
            holding = dynamics.components(model, Motion(q, rest, rest), ["gravity"])["gravity"].mean
        feedback = self.stiffness * (desired[0] - q) + self.damping * (desired[1] - dq)
        share, trust, out = 0.0, 0.0, np.empty_like(q)
        for k, step in enumerate(dt):
            if k < stop:
                trust = min(1.0, trust + step / self.ramp_s)
                wish = trust * moving[k] + feedback[k]
            share = np.clip(share + (1.0 if k < stop else -10.0) * step / self.ramp_s, 0.0, 1.0)
            wanted = np.clip(holding[k] + share * wish, -self.max_torque, self.max_torque)
            before = out[k - 1] if k else wanted
            out[k] = np.clip(wanted, before - self.max_rate * step, before + self.max_rate * step) if k else wanted
        return out


def move_and_return(start: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the motion that the recipes ask for: 0.1 rad from the start and back in 4 s, (3, N, n)."""
    rate, t = 2 * np.pi / 4.0, t[:, None]
    moved = [0.05 * (1 - np.cos(rate * t)), 0.05 * rate * np.sin(rate * t), 0.05 * rate**2 * np.cos(rate * t)]
    return np.stack([moved[0] + start, *(each + np.zeros_like(start) for each in moved[1:])])
