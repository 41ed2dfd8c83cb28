"""A bucket of an S3-compatible service as an object store, by s3fs (fsspec).

Credentials, region and endpoint come from the usual AWS_ variables, files or roles. They are never logged here.
"""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import s3fs
from botocore.exceptions import BotoCoreError, NoCredentialsError, PartialCredentialsError
from fsspec.asyn import sync
from fsspec.exceptions import FSTimeoutError

from service.storage.files.objects import Entry, FilesUnreachableError, unreachable


@dataclass(frozen=True)
class BucketOptions:
    """Options of requests to a bucket."""

    connect_s: int = 5
    """Max wait for a connection, s."""
    read_s: int = 30
    """Max wait for the next bytes, s."""
    attempts: int = 2
    """Max times that a request is sent."""
    part_bytes: int = 16 << 20
    """Bytes of a part of a large object."""
    max_parts: int = 2
    """Max parts that are in transfer, and in memory, at a time."""


BUCKET = BucketOptions()


NO_BUCKET = "there is no such bucket"


class Bucket:
    """Objects of a bucket with keys that begin with a prefix; safe from several threads of one process."""

    def __init__(self, bucket: str, prefix: str) -> None:
        self._bucket, self._prefix = bucket, prefix
        self._root = f"{bucket}/{prefix}".rstrip("/")
        self._system = s3fs.S3FileSystem(
            skip_instance_cache=True,  # a forked parent's instance would use the parent's connections
            use_listings_cache=False,
            config_kwargs={
                "connect_timeout": BUCKET.connect_s,
                "read_timeout": BUCKET.read_s,
                "retries": {"total_max_attempts": BUCKET.attempts, "mode": "standard"},
            },
        )
        self._system.retries = 1  # s3fs retries on top of the library's retries

    def put(self, path: Path, key: str) -> None:
        """Store a file; a large one is sent in parts and appears after the last one."""
        with _of_store(missing=NO_BUCKET):
            self._system.put_file(
                str(path), self._path(key), chunksize=BUCKET.part_bytes, max_concurrency=BUCKET.max_parts
            )

    def get(self, key: str, path: Path) -> None:
        """Copy an object into a new file; raise FileNotFoundError if there is none."""
        with _of_store():
            try:
                self._system.get_file(
                    self._path(key), str(path), chunksize=BUCKET.part_bytes, max_concurrency=BUCKET.max_parts
                )
            except FileNotFoundError:
                self.check()  # a missing bucket does not mean that its objects are lost
                raise

    def delete(self, key: str) -> None:
        """Delete an object; do nothing if there is none."""
        with _of_store(missing=NO_BUCKET):
            self._system.rm_file(self._path(key))

    def list(self, prefix: str) -> Iterator[Entry]:
        """Yield objects with keys that begin with `prefix`."""
        parent, _, beginning = prefix.rpartition("/")
        with _of_store(missing=NO_BUCKET):
            objects: dict[str, Any] = self._system.find(self._path(parent), detail=True, prefix=beginning)
        for path, about in objects.items():
            if about["type"] == "file":
                yield Entry(path.removeprefix(f"{self._root}/"), about["LastModified"].timestamp())

    def check(self) -> None:
        """Check that the bucket exists and can be listed."""
        with _of_store(missing=NO_BUCKET):
            prefix = f"{self._prefix}/" if self._prefix else ""
            asked = {"Bucket": self._bucket, "Prefix": prefix, "MaxKeys": 1}
            sync(self._system.loop, self._system._call_s3, "list_objects_v2", timeout=3.0, **asked)

    def _path(self, key: str) -> str:
        return f"{self._root}/{key}"


@contextmanager
def _of_store(missing: str | None = None) -> Iterator[None]:
    """Translate errors of the store into FilesUnreachableError, without the address and the library's text."""
    try:
        yield
    except FilesUnreachableError:
        raise
    except FileNotFoundError:
        if missing is None:
            raise
        raise unreachable(missing) from None
    except PermissionError:
        raise unreachable("access is denied: check the credentials and what they may do in the bucket") from None
    except (NoCredentialsError, PartialCredentialsError):
        raise unreachable("no credentials: set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or a role") from None
    except (TimeoutError, FSTimeoutError):
        raise unreachable("the store does not answer in time") from None
    except BotoCoreError as error:
        raise unreachable(f"the store does not answer ({type(error).__name__})") from None
    except OSError as error:
        # an error of this host's disk while an object was fetched
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise
        raise unreachable(
            f"the store rejects the request ({type(error).__name__}: {error.strerror or error})"
        ) from None
