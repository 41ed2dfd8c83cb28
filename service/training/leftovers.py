"""Files of versions that a job began to write and did not publish."""

from __future__ import annotations

import logging

from sqlalchemy import select

from service.foundation.states import ACTIVE
from service.storage.database import Database, JobRow, VersionRow
from service.storage.files import Files, new_id

logger = logging.getLogger(__name__)


def new_folder(job: str) -> str:
    """A fresh name for a folder of a version that `job` makes, from which the job can be told."""
    return new_id(f"mv_{_mark(job)}")


def remove(database: Database, files: Files, job: str) -> int:
    """Delete what a job that runs nowhere has written and no version names; return how many folders.

    Where several services share the files it is done once the job has ended, else when they are swept.
    """
    try:
        names = files.versions_marked(_mark(job))
        if not names:
            return 0
        with database.session() as session:
            state = session.scalar(select(JobRow.state).where(JobRow.id == job))
            if files.shared and state in ACTIVE:  # another service may be about to publish them
                return 0
            known = set(session.scalars(select(VersionRow.folder).where(VersionRow.folder.in_(names))))
        left = [name for name in names if name not in known]
        for name in left:
            files.delete_version(name)
    except OSError as error:
        logger.warning("files that job %s did not publish are left until they are swept: %s", job, error)
        return 0
    return len(left)


def _mark(job: str) -> str:
    return job.removeprefix("job_")
