"""Access of commands to a service: errors with hints, uploads, waiting for jobs, shell completion.

Completion must be fast: it queries a running service for at most a second and imports no client.
"""

from __future__ import annotations

import hashlib
import http.client
import json
import shlex
import shutil
import socket
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from http.client import HTTPException
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote, urlsplit

import typer

from lipserve.address import UNIX, headers_of, url_of
from service.cli.consoles import START, CommandError, Explained, err, explain, note
from service.cli.wording import FLAGS, in_shell
from service.contract.media_types import SUFFIXES

if TYPE_CHECKING:
    from lipserve import Client
    from lipserve.records.datasets import Dataset
    from lipserve.records.jobs import Job


class _UnixConnection(http.client.HTTPConnection):
    """HTTP over a Unix-domain socket."""

    def __init__(self, path: str, timeout: float) -> None:
        super().__init__("localhost", timeout=timeout)
        self._path = path

    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX)
        self.sock.settimeout(self.timeout)
        self.sock.connect(self._path)


def ask(url: str, path: str, timeout: float = 1.0) -> Any:
    """Return the JSON at a path of a service; send the key in LIPSERVE_API_KEY.

    Raise OSError, HTTPException or ValueError if there is no valid answer in time.
    """
    parts = urlsplit(url)
    connection: http.client.HTTPConnection
    if url.startswith(UNIX):
        connection = _UnixConnection(url.removeprefix(UNIX), timeout)
    else:
        kind = http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
        connection = kind(parts.netloc, timeout=timeout)
    try:
        connection.request("GET", path, headers=headers_of(None))
        answer = connection.getresponse()
        if answer.status != http.client.OK:
            raise ValueError(f"status {answer.status}")
        return json.loads(answer.read())
    finally:
        connection.close()


Names = list[str | tuple[str, str]]
"""Completions, with descriptions if there are any."""


def models(context: typer.Context) -> Names:
    """Complete names of models."""
    return _listed(
        context,
        "/v1/models?limit=100",
        lambda each: (each["name"], f"serving version: {each['serving_version'] or 'none'}"),
    )


def datasets(context: typer.Context) -> Names:
    """Complete ids of data sets."""
    return _listed(context, "/v1/datasets?limit=100", lambda each: (each["id"], each["name"]))


def jobs(context: typer.Context) -> Names:
    """Complete ids of jobs."""
    return _listed(context, "/v1/jobs?limit=100", lambda each: (each["id"], f"{each['state']}: {each['model']}"))


def versions(context: typer.Context) -> Names:
    """Complete versions of the model on the command line."""
    return [(str(each["version"]), each["estimator"]) for each in _model(context).get("versions", ())]


def aliases(context: typer.Context) -> Names:
    """Complete aliases of the model on the command line."""
    return [
        ("serving", "the serving version"),
        *((name, f"version {at}") for name, at in _model(context)["aliases"].items()),
    ]


def _model(context: typer.Context) -> dict[str, Any]:
    name = context.params.get("model")
    record = _get_or_none(context, f"/v1/models/{quote(name, safe='')}") if name else None
    return record if isinstance(record, dict) else {"aliases": {}}


def _listed(context: typer.Context, path: str, name: Callable[[dict[str, Any]], tuple[str, str]]) -> Names:
    listed = _get_or_none(context, path)
    return [name(each) for each in listed["items"]] if isinstance(listed, dict) else []


def _get_or_none(context: typer.Context, path: str) -> Any:
    url = url_of(context.params.get("url"))
    try:
        return ask(url, path)
    except (OSError, HTTPException, ValueError):
        return None


MAX_HINT_MODELS = 20
"""Max number of models that a hint lists."""


@contextmanager
def connected(url: str) -> Iterator[Client]:
    """Yield a client of the service at `url`; raise CommandError with a hint if it fails or refuses a request."""
    # slow imports, not needed for help
    from lipserve import ApiError, Client, ServiceUnreachableError  # noqa: PLC0415
    from lipserve.answers import StreamError  # noqa: PLC0415

    try:
        with Client(url) as client:
            yield client
    except (ApiError, StreamError) as error:
        refusal = explain(error, (ApiError, StreamError)) or Explained(str(error))
        raise CommandError(in_shell(refusal.message), refusal.hint or _existing(url, str(error))) from error
    except ServiceUnreachableError as error:
        raise CommandError(str(error), None if "lipserve serve" in str(error) else START) from error


def dataset_of(client: Client, data: str, **reading: Any) -> str:
    """Return the id or name of a data set; a recording is uploaded first."""
    path = recording_of(data)
    if path is None and reading:
        options = ", ".join(FLAGS[name] for name in reading)
        raise CommandError(f"data is {data!r}: {options} can only be used with a recording, not with a data set")
    if path is None:
        return data
    if not reading and (made := _made_of(client, path)) is not None:
        return _noted(path, made)
    adding = f"`lipserve data add {shlex.quote(data)}`"
    hint = f"upload it with {adding}, which has options for reading; then run this command again"
    with advised(hint):
        dataset = upload(client, [path], **reading)
    return _noted(path, dataset)


def _noted(path: Path, dataset: Dataset) -> str:
    """Print which data set a recording is, and its warnings; return its id."""
    note(f"{path.name} is data set {dataset.id}")
    for warning in dataset.report.warnings:
        note(f"warning: {in_shell(warning)}")
    return dataset.id


def _made_of(client: Client, path: Path) -> Dataset | None:
    """Return the newest data set that was made from a file, or None."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return next(iter(client.datasets(digest)), None)


@contextmanager
def advised(hint: str | None) -> Iterator[None]:
    """Add a hint to the error if the service cannot read a recording; raise CommandError."""
    from lipserve import ApiError  # noqa: PLC0415 - as above

    try:
        yield
    except ApiError as error:
        if error.code != "invalid_data" or hint is None:
            raise
        refusal = explain(error, (ApiError,)) or Explained(str(error))
        raise CommandError(in_shell(refusal.message), hint) from error


def recording_of(data: str) -> Path | None:
    """Return the file that an argument names, None if it names a data set; raise CommandError for a missing file."""
    path = Path(data)
    if path.is_file():
        return path
    if path.is_dir() or (path.suffix.lower() in SUFFIXES and path.name != data):
        raise CommandError(
            f"{data!r} is neither a recording nor the id or name of a data set",
            "`lipserve data list` shows the data sets",
        )
    return None


def urdf_of(robot: str | None) -> Path | None:
    """Return the .urdf file that an argument names, None if it names another robot; raise CommandError."""
    if robot is None or not robot.endswith(".urdf"):
        return None
    if not Path(robot).is_file():
        raise CommandError(f"--robot is {robot!r}, but this file does not exist")
    return Path(robot)


def robot_of(client: Client, robot: str) -> str:
    """Return the id of a robot. A .urdf file is uploaded, unless it is there already; raise CommandError."""
    if (path := urdf_of(robot)) is None:
        return robot
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    known = (each.id for each in islice(client.robots(), MAX_KNOWN_ROBOTS) if each.sha256 == digest)
    with advised(f"`lipserve robots add {shlex.quote(robot)}` has options for units; then use its id as --robot"):
        return next(known, None) or client.upload_robot(path).id


MAX_KNOWN_ROBOTS = 200
"""Max number of uploaded robots that are compared with a file."""


def upload(client: Client, paths: Sequence[Path], name: str | None = None, **reading: Any) -> Dataset:
    """Upload a recording; the same content with the same name and options gives the same data set.

    paths: one file, or text tables to be joined.
    """
    content = hashlib.sha256(json.dumps([name or paths[0].name, reading], sort_keys=True).encode())
    for path in paths:
        content.update((path.suffix.lower() if len(paths) == 1 else path.name).encode())
        with path.open("rb") as file:
            content.update(hashlib.file_digest(file, "sha256").digest())
    key = f"content-{content.hexdigest()}"
    if len(paths) == 1:
        return client.upload(paths[0], name, progress=True, idempotency_key=key, **reading)
    with tempfile.TemporaryDirectory() as folder:
        joined = Path(folder) / "joined.zip"
        with zipfile.ZipFile(joined, "w") as archive:
            for path in paths:
                entry = zipfile.ZipInfo(path.name)  # without date: equal files give equal archives
                entry.compress_type = zipfile.ZIP_DEFLATED
                with path.open("rb") as file, archive.open(entry, "w", force_zip64=True) as member:
                    shutil.copyfileobj(file, member)
        called = name or "+".join(path.stem for path in paths)
        return client.upload(joined, called, progress=True, idempotency_key=key, **reading)


def _existing(url: str, message: str) -> str | None:
    """Return a hint that lists existing items when one was not found."""
    if message.startswith("no model"):
        try:
            names = [each["name"] for each in ask(url, f"/v1/models?limit={MAX_HINT_MODELS}")["items"]]
        except (OSError, HTTPException, ValueError, KeyError):  # keep the original error
            return None
        return (
            f"existing models: {', '.join(names)}" if names else "there are no models yet: `lipserve train` makes one"
        )
    return next((hint for start, hint in _LISTS.items() if message.startswith(start)), None)


_LISTS = {
    "no dataset": "`lipserve data list` shows the data sets; to use a recording, give its path",
    "no job": "`lipserve jobs list` shows the jobs",
    "no version": "`lipserve models show MODEL` shows the versions",
    "no alias": "`lipserve models show MODEL` shows the aliases",
}


PATIENCE, PAUSE = 300.0, 1.0
"""Max time to wait for an unreachable service, and time between two attempts, s."""


def watch(client: Client, job: Job, cancels: bool, patience: float = PATIENCE) -> tuple[Job, bool]:
    """Show a job's progress on standard error until it ends or Ctrl-C is pressed.

    Args:
        client: Client of the service.
        job: The job.
        cancels: Whether Ctrl-C cancels the job and waits for its end; a second Ctrl-C does not wait.
        patience: Max time to wait for an unreachable service, s.

    Returns:
        The job as last seen, and whether Ctrl-C was pressed.

    Raises:
        CommandError: The service is unreachable for longer than `patience`.
    """
    from lipserve.progress import job_bar  # noqa: PLC0415 - slow import, not needed for help

    try:
        with job_bar(err) as show:
            return _waited(client, job.id, show, patience), False
    except KeyboardInterrupt:
        if not cancels:
            return client.job(job.id), True
        note(f"Cancelling {job.id} …")
        client.cancel(job.id)
        return client.wait(job.id), True


def _waited(client: Client, job: str, show: Callable[[Job], None], patience: float) -> Job:
    """Wait for a job to end and return it; if the service restarts, wait for it, because the job continues."""
    from lipserve import ApiError, ServiceUnreachableError  # noqa: PLC0415 - as above

    lost_at: float | None = None

    def report(seen: Job) -> None:
        nonlocal lost_at
        if lost_at is not None:
            lost_at = None
            note("the service is reachable again")
        show(seen)

    while True:
        try:
            return client.wait(job, report)
        except (ApiError, ServiceUnreachableError) as error:
            # the service is starting or stopping, or a proxy answers instead
            if isinstance(error, ApiError) and error.status not in (429, 502, 503, 504):
                raise
            now = time.monotonic()
            if lost_at is None:
                lost_at = now
                note(f"{error}; {job} continues when the service is back: waiting up to {patience:.0f} s")
            if now - lost_at >= patience:
                hint = f"the job may continue: run `lipserve jobs follow {job}` when the service is back"
                raise CommandError(f"the service has been unreachable for {patience:.0f} s", hint) from error
            time.sleep(min(PAUSE, patience))
