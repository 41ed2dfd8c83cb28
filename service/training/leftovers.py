"""Files of versions that a job began to write and did not publish."""

from __future__ import annotations

import shutil

from sqlalchemy import select

from service.database import Database, VersionRow
from service.files import Files, new_id


def new_folder(job: str) -> str:
    """A fresh name for a folder of a version that `job` makes, from which the job can be told."""
    return f"{new_id('mv')}_{_mark(job)}"


def remove(database: Database, files: Files, job: str) -> int:
    """Delete what a job that runs nowhere has written and no version names; return how many folders."""
    left = [path for path in files.versions.glob(f"*{_mark(job)}*") if path.is_dir()]
    if not left:
        return 0
    with database.session() as session:
        names = [path.name for path in left]
        known = set(session.scalars(select(VersionRow.folder).where(VersionRow.folder.in_(names))))
    left = [path for path in left if path.name not in known]
    for path in left:
        shutil.rmtree(path, ignore_errors=True)  # what cannot be deleted now is swept at the next start
    return len(left)


def _mark(job: str) -> str:
    return job.removeprefix("job_")
