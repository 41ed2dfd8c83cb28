"""What has been learnt, handed from the learner process to the service through a folder of arrays.

The service reads them into memory and removes them: nothing is unpickled or computed there, and reading does without
the interpreter's lock. Mapping them into memory instead was measured to be worse: to unmap files of 13 MB takes a
millisecond with that lock held, in whichever thread is the last to let go of them, maybe that of a control loop.
"""

from __future__ import annotations

import shutil
from dataclasses import fields
from pathlib import Path

import numpy as np

from lipcore.online.transfer import Revision
from service.storage.files import Files, new_id

NAMES = tuple(each.name for each in fields(Revision))


def folder(files: Files) -> Path:
    """Where publications lie until they are read."""
    return files.learning / "published"


def clear(files: Files) -> Path:
    """Remove what nobody has read; return the folder."""
    found = folder(files)
    shutil.rmtree(found, ignore_errors=True)
    found.mkdir(parents=True)
    return found


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
