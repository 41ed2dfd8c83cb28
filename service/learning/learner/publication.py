"""What the learner process tells the service: messages, and the arrays of revisions, which lie in a folder.

The service reads the arrays into memory and removes them: nothing is unpickled or computed there, and reading does
without the interpreter's lock. Mapping them into memory instead was measured to be worse: to unmap files of 13 MB takes
a millisecond with that lock held, in whichever thread is the last to let go of them, maybe that of a control loop.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from lipcore.online.transfer import Revision
from service.storage.files import Files, new_id

NAMES = tuple(each.name for each in fields(Revision))


@dataclass(frozen=True)
class Published:
    """A version has learnt up to event `number`; answers of `revision` contain that.

    path: of the arrays, see `write`; samples: weight of the rows learnt in this regime; novel_rows: rows beyond the
    basis since the process follows the version, novel_share: their share of the last ones; seconds: that learning
    and solving took; at: Unix time, s; linearisation: error of taking a learnt arm as linear, one number a joint, in
    units of what is stated, see `lipcore.arm.linearisation`; None without such an arm.
    """

    model: str
    version: int
    revision: int
    number: int
    path: Path
    samples: float
    novel_rows: int
    novel_share: float
    seconds: float
    at: float
    linearisation: tuple[float, ...] | None = None


@dataclass(frozen=True)
class Failed:
    """A version cannot learn; it is tried again later. error: why, for people."""

    model: str
    version: int
    error: str


Message = Published | Failed


def folder(files: Files) -> Path:
    """Where publications lie until they are read."""
    return files.learning / "published"


def clear(files: Files) -> Path:
    """Remove what nobody has read; return the folder."""
    target = folder(files)
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    return target


def write(target: Path, revision: Revision) -> Path:
    """Write the arrays of a revision below a folder; return where."""
    path = target / new_id("rev")
    path.mkdir()
    try:
        for name in NAMES:
            np.save(path / f"{name}.npy", getattr(revision, name), allow_pickle=False)
    except OSError:
        shutil.rmtree(path, ignore_errors=True)  # nobody will read it
        raise
    return path


def read(path: Path) -> Revision:
    """Read what `write` wrote, and remove it. Raise FileNotFoundError where it is gone."""
    arrays = {name: np.load(path / f"{name}.npy", allow_pickle=False) for name in NAMES}
    shutil.rmtree(path)
    return Revision(**arrays)
