"""Messages from the learner process to the service, and the arrays of revisions, which are files in a folder.

The service reads the arrays into memory and removes the files. It unpickles and computes nothing, and reading does not
need the interpreter's lock. Mapping the files into memory was slower: to unmap 13 MB takes a millisecond with that lock
held, in the thread that drops the last reference, which may serve a control loop.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from lipcore.model.parameters import NegativeFriction
from lipcore.online.transfer import Revision
from service.storage.files import Files, new_id

ARRAY_NAMES = tuple(each.name for each in fields(Revision))
"""Names of the arrays of a revision."""


@dataclass(frozen=True)
class Publication:
    """Message that a revision of a version is ready. It contains the events up to `number`."""

    model: str
    version: int
    revision: int
    number: int
    path: Path
    """Folder of the arrays, see `write`."""
    samples: float
    """Weight of the rows learnt in this regime."""
    novel_rows: int
    """Rows beyond the basis since the process began to follow the version."""
    novel_share: float
    """Share of rows beyond the basis among the last ones."""
    seconds: float
    """Seconds of learning and solving."""
    at: float
    """Unix time, s."""
    linearisation: tuple[float, ...] | None = None
    """Error of each joint from linearising a learnt arm, in units of the stated error; None without such an arm."""
    negative_friction: tuple[NegativeFriction, ...] = ()
    """Coefficients of friction that are negative, however uncertain."""


@dataclass(frozen=True)
class LearningFailure:
    """Message that a version cannot learn and will be tried again. error: the reason, for people."""

    model: str
    version: int
    error: str


Message = Publication | LearningFailure


def folder(files: Files) -> Path:
    """Return the folder of publications that have not been read."""
    return files.learning / "published"


def clear(files: Files) -> Path:
    """Remove publications that were not read; return the folder."""
    target = folder(files)
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    return target


def write(target: Path, revision: Revision) -> Path:
    """Write the arrays of a revision below a folder; return their path."""
    path = target / new_id("rev")
    path.mkdir()
    try:
        for name in ARRAY_NAMES:
            np.save(path / f"{name}.npy", getattr(revision, name), allow_pickle=False)
    except OSError:
        shutil.rmtree(path, ignore_errors=True)  # remove the incomplete files: nobody reads them
        raise
    return path


def read(path: Path) -> Revision:
    """Read what `write` wrote and remove it. Raise FileNotFoundError if it is gone."""
    arrays = {name: np.load(path / f"{name}.npy", allow_pickle=False) for name in ARRAY_NAMES}
    shutil.rmtree(path)
    return Revision(**arrays)
