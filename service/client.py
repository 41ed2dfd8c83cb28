"""A Python client of the service."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self, Unpack
from urllib.parse import quote

import httpx
import numpy as np
from numpy.typing import ArrayLike

from service.access.credentials import headers_of
from service.datasets.asking import Reading, query_of
from service.datasets.media import MEDIA_TYPE_OF, SUFFIXES
from service.datasets.schema import Dataset
from service.inference.schema import EvaluateResponse, PredictResponse
from service.models.alias_schema import Alias, AliasList
from service.models.comparison_schema import CompareResponse
from service.models.schema import Model, Version
from service.robots.schema import Robot
from service.settings import DEFAULT_URL
from service.training.schema import Job
from service.training.states import ACTIVE
from service.updates.control.learning_schema import AlarmPage, Decided, Learning
from service.updates.control.schema import (
    ObservationDetail,
    ObservationPage,
    Quality,
    Replayed,
    RolledBack,
    Unlearnt,
)
from service.updates.schema import ObservationResponse

UPLOAD_TIMEOUT = 600.0
"""Longest wait for a recording to be read and prepared, s."""
POLL_SECONDS = 0.3
UNIX = "unix://"
NO_HOST = "http://localhost"
"""What HTTP says the host is where a socket leads to the service."""


class ServiceUnreachableError(ConnectionError):
    """No service answers at the address."""


class ApiError(RuntimeError):
    """The service refused a request. status: of HTTP; code, message, detail: as the service says."""

    def __init__(self, status: int, code: str, message: str, detail: list[dict[str, Any]]) -> None:
        super().__init__(message)
        self.status, self.code, self.message, self.detail = status, code, message, detail


class Client:
    """Synchronous client; use it as a context manager or close it.

    url: http://host:port, or unix:///path of the service's Unix-domain socket; key: API key, that of the environment
    variable LIPSERVE_KEY where None.
    """

    def __init__(self, url: str = DEFAULT_URL, timeout: float = 120.0, key: str | None = None) -> None:
        self.url = url
        path = url.removeprefix(UNIX) if url.startswith(UNIX) else None
        if path is not None and not path.startswith("/"):
            raise ValueError(f"url is {url!r}, expected unix:// and an absolute path, as unix:///run/lipserve.sock")
        transport = None if path is None else httpx.HTTPTransport(uds=path)
        self._http = httpx.Client(
            base_url=url if path is None else NO_HOST, timeout=timeout, transport=transport, headers=headers_of(key)
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def ready(self) -> bool:
        """Whether the service can answer queries now."""
        try:
            return self._http.get("/health/ready").status_code == httpx.codes.OK
        except httpx.TransportError:
            return False

    def upload(self, path: Path, name: str | None = None, **reading: Unpack[Reading]) -> Dataset:
        """Upload a recording; raise ValueError for an ending that says no format, ApiError where it is refused.

        reading: how it is to be read and prepared, such as `robot="panda"` or `units={"q": "deg"}`.
        """
        media_type = MEDIA_TYPE_OF.get(path.suffix.lower())
        if media_type is None:
            raise ValueError(f"file is {path.name!r}, expected the ending {', '.join(SUFFIXES)}")
        params = {"name": name or path.name, **query_of(reading)}
        headers = {"content-type": media_type}
        with path.open("rb") as file:
            answer = self._send(
                "POST", "/v1/datasets", params=params, content=_chunks(file), headers=headers, timeout=UPLOAD_TIMEOUT
            )
        return Dataset.model_validate(answer)

    def datasets(self) -> list[Dataset]:
        """All data sets, newest first."""
        found: list[Dataset] = []
        cursor: dict[str, str] = {}
        while True:
            page = self._send("GET", "/v1/datasets", params=cursor)
            found += [Dataset.model_validate(item) for item in page["items"]]
            if page["next_cursor"] is None:
                return found
            cursor = {"cursor": page["next_cursor"]}

    def dataset(self, dataset: str) -> Dataset:
        """One data set with its report; raise ApiError where there is none."""
        return Dataset.model_validate(self._send("GET", f"/v1/datasets/{quote(dataset, safe='')}"))

    def upload_robot(self, path: Path, name: str | None = None) -> Robot:
        """Upload a URDF; raise ApiError where it is refused."""
        params = {} if name is None else {"name": name}
        headers = {"content-type": "application/xml"}
        answer = self._send("POST", "/v1/robots", params=params, content=path.read_bytes(), headers=headers)
        return Robot.model_validate(answer)

    def train(
        self,
        model: str,
        datasets: list[str],
        estimator: str | None = None,
        joint_types: list[str] | None = None,
        options: dict[str, Any] | None = None,
        robot: str | None = None,
        holdout: dict[str, Any] | None = None,
    ) -> Job:
        """Queue a training job.

        robot: for rigid bodies, a profile such as panda or the id of an uploaded URDF; holdout: what to hold out of the
        data sets and evaluate the version on, such as {"kind": "last", "share": 0.3}.
        """
        body: dict[str, Any] = {"model": model, "datasets": datasets, "options": options or {}}
        if estimator is not None:
            body["estimator"] = estimator
        if joint_types is not None:
            body["joint_types"] = joint_types
        if robot is not None:
            body["robot"] = robot
        if holdout is not None:
            body["holdout"] = holdout
        return Job.model_validate(self._send("POST", "/v1/jobs", json=body))

    def job(self, job: str) -> Job:
        """Return a job with its progress."""
        return Job.model_validate(self._send("GET", f"/v1/jobs/{job}"))

    def cancel(self, job: str) -> Job:
        """Cancel a job."""
        return Job.model_validate(self._send("POST", f"/v1/jobs/{job}/cancel"))

    def retry(self, job: str) -> Job:
        """Queue a new job that repeats one that failed or was cancelled."""
        return Job.model_validate(self._send("POST", f"/v1/jobs/{job}/retry"))

    def job_events(self, job: str) -> Iterator[Job]:
        """Yield a job as it is and at every change, until it ends or the service stops."""
        with self._reached(), self._http.stream("GET", f"/v1/jobs/{job}/events") as answer:
            if not answer.is_success:
                answer.read()
                raise _refused(answer)
            for line in answer.iter_lines():
                if line.startswith("data: "):
                    yield Job.model_validate_json(line.removeprefix("data: "))

    def wait(self, job: str, on_progress: Callable[[Job], None] | None = None) -> Job:
        """Wait for a job's end, however it ends; on_progress is called with every look at it."""
        while True:
            seen = self.job(job)
            if on_progress is not None:
                on_progress(seen)
            if seen.state not in ACTIVE:
                return seen
            time.sleep(POLL_SECONDS)

    def model(self, model: str) -> Model:
        """Return a model with its versions."""
        return Model.model_validate(self._send("GET", f"/v1/models/{model}"))

    def version(self, model: str, version: int) -> Version:
        """Return one version of a model."""
        return Version.model_validate(self._send("GET", f"/v1/models/{model}/versions/{version}"))

    def predict(
        self,
        model: str,
        q: ArrayLike,
        dq: ArrayLike,
        ddq: ArrayLike,
        version: int | None = None,
        covariance: bool = False,
        components: Sequence[str] = (),
        tau: ArrayLike | None = None,
        alias: str | None = None,
    ) -> PredictResponse:
        """Torque for arrays of shape (n,) or (N, n), and components by name; tau is for `forward_dynamics` only.

        The version that serves answers, unless one is named by its number or an alias.
        """
        body: dict[str, Any] = {"covariance": covariance, "components": list(components)}
        for name, values in (("q", q), ("dq", dq), ("ddq", ddq), ("tau", tau)):
            if values is not None:
                body[name] = np.asarray(values, dtype=np.float64).tolist()
        body |= _named(version, alias)
        return PredictResponse.model_validate(self._send("POST", f"/v1/models/{model}/predict", json=body))

    def evaluate(
        self, model: str, dataset: str, version: int | None = None, alias: str | None = None, part: str = "all"
    ) -> EvaluateResponse:
        """Compare a model with a data set: the version that serves, unless one is named by its number or an alias.

        part: `held_out` compares with what the version's training has held out of the data set.
        """
        body = {"dataset": dataset, "part": part} | _named(version, alias)
        return EvaluateResponse.model_validate(self._send("POST", f"/v1/models/{model}/evaluate", json=body))

    def compare(self, model: str, dataset: str, first: int | str, second: int | str) -> CompareResponse:
        """Compare two versions, each a number or an alias, on a data set."""
        body = {"dataset": dataset, "versions": [first, second]}
        return CompareResponse.model_validate(self._send("POST", f"/v1/models/{model}/compare", json=body))

    def aliases(self, model: str) -> list[Alias]:
        """Every alias of a model, `serving` first."""
        return AliasList.model_validate(self._send("GET", f"/v1/models/{model}/aliases")).items

    def set_alias(self, model: str, alias: str, version: int | str) -> Alias:
        """Point an alias to a version, or to where another alias points; `serving` answers where none is named."""
        body = {"alias": version} if isinstance(version, str) else {"version": version}
        return Alias.model_validate(self._send("PUT", f"/v1/models/{model}/aliases/{alias}", json=body))

    def rollback_alias(self, model: str, alias: str) -> Alias:
        """Take back the last move of an alias, the next time the one before it."""
        return Alias.model_validate(self._send("POST", f"/v1/models/{model}/aliases/{alias}/rollback"))

    def remove_alias(self, model: str, alias: str) -> None:
        """Remove an alias; its version stays."""
        self._send("DELETE", f"/v1/models/{model}/aliases/{alias}")

    def delete_version(self, model: str, version: int) -> None:
        """Delete a version that nothing needs, for good."""
        self._send("DELETE", f"/v1/models/{model}/versions/{version}")

    def delete_model(self, model: str) -> None:
        """Delete a model with all that it has observed and learnt, for good."""
        self._send("DELETE", f"/v1/models/{model}")

    def observe(
        self,
        model: str,
        stream_id: str,
        sequence: int,
        q: ArrayLike,
        dq: ArrayLike,
        tau: ArrayLike,
        ddq: ArrayLike | None = None,
        t: ArrayLike | None = None,
        joint_names: Sequence[str] | None = None,
    ) -> ObservationResponse:
        """Teach a model with measured rows, arrays of shape (N, n) or (n,), times (N,); repeat it until it is answered.

        A number that is not finite keeps its row out of learning. Raise ApiError where the batch is refused.
        """
        body: dict[str, Any] = {"stream_id": stream_id, "sequence": sequence}
        for name, values in (("t", t), ("q", q), ("dq", dq), ("ddq", ddq), ("tau", tau)):
            if values is not None:
                numbers = np.asarray(values, dtype=np.float64)
                shown = numbers.astype(object)
                shown[~np.isfinite(numbers)] = None  # JSON has no such numbers
                body[name] = shown.tolist()
        if joint_names is not None:
            body["joint_names"] = list(joint_names)
        return ObservationResponse.model_validate(self._send("POST", f"/v1/models/{model}/observations", json=body))

    def quality(self, model: str) -> Quality:
        """How well a model predicts what it has not learnt yet, over sliding windows."""
        return Quality.model_validate(self._send("GET", f"/v1/models/{model}/quality"))

    def observations(
        self, model: str, stream_id: str | None = None, rejected: bool = False, cursor: str | None = None
    ) -> ObservationPage:
        """One page of the batches of a model's log, newest first; cursor: `next_cursor` of the page before."""
        given = {"stream_id": stream_id, "cursor": cursor, "rejected": rejected or None}
        params = {name: value for name, value in given.items() if value is not None}
        return ObservationPage.model_validate(self._send("GET", f"/v1/models/{model}/observations", params=params))

    def observation(self, model: str, stream_id: str, sequence: int, rows: bool = False) -> ObservationDetail:
        """One batch, with its rows where asked for."""
        path = f"/v1/models/{model}/observations/{stream_id}/{sequence}"
        return ObservationDetail.model_validate(self._send("GET", path, params={"rows": rows}))

    def unlearn(self, model: str, stream_id: str, sequence: int) -> Unlearnt:
        """Take a batch out of what is learnt."""
        return Unlearnt.model_validate(self._send("DELETE", f"/v1/models/{model}/observations/{stream_id}/{sequence}"))

    def replay(self, model: str, stream_id: str, sequence: int, codes: Sequence[str] | None = None) -> Replayed:
        """Learn rows of a batch after all that were kept out, by these codes or by any."""
        path = f"/v1/models/{model}/observations/{stream_id}/{sequence}/replay"
        body = {} if codes is None else {"codes": list(codes)}
        return Replayed.model_validate(self._send("POST", path, json=body))

    def rollback(self, model: str, revision: int | None = None, version: int | None = None) -> RolledBack:
        """Go back to a revision of the version that serves, or to another version: name one of the two."""
        given = {"revision": revision, "version": version}
        body = {name: value for name, value in given.items() if value is not None}
        return RolledBack.model_validate(self._send("POST", f"/v1/models/{model}/rollback", json=body))

    def learning(self, model: str) -> Learning:
        """How a model learns, and where that stands."""
        return Learning.model_validate(self._send("GET", f"/v1/models/{model}/learning"))

    def set_learning(self, model: str, **options: Any) -> Learning:
        """Set how a model learns; options of `LearningOptions` by name, those left out keep their values."""
        wanted = {**self.learning(model).options.model_dump(), **options}
        return Learning.model_validate(self._send("PUT", f"/v1/models/{model}/learning", json=wanted))

    def decide(self, model: str, decision: str, replay: bool = False) -> Decided:
        """End a hold: `adapt` to the changed robot, or `ignore`. replay: learn the rows that were kept out since."""
        body = {"decision": decision, "replay": replay}
        return Decided.model_validate(self._send("POST", f"/v1/models/{model}/learning/change", json=body))

    def alarms(self, model: str, cursor: str | None = None) -> AlarmPage:
        """One page of a model's alarms, newest first."""
        params = {} if cursor is None else {"cursor": cursor}
        return AlarmPage.model_validate(self._send("GET", f"/v1/models/{model}/alarms", params=params))

    def export_model(
        self, model: str, path: Path, version: int | None = None, alias: str | None = None, learnt: bool = True
    ) -> Path:
        """Write a version as an archive to `path`, whole or not at all, and return it; see `import_model`.

        The version that serves, unless one is named. learnt: with what it has learnt online, else as it was trained.
        """
        params = _named(version, alias) | {"learnt": learnt}
        draft = path.with_name(f"{path.name}.part")
        try:
            with self._reached(), self._http.stream("GET", f"/v1/models/{model}/export", params=params) as answer:
                if not answer.is_success:
                    answer.read()
                    raise _refused(answer)
                with draft.open("wb") as file:
                    for piece in answer.iter_bytes():
                        file.write(piece)
            draft.replace(path)
        finally:
            draft.unlink(missing_ok=True)
        return path

    def import_model(self, path: Path, name: str | None = None) -> Version:
        """Make a new version of an archive that a service has exported; raise ApiError where it is refused.

        name: of the model, that of the archive by default. The version answers where the model had none before.
        """
        params = {} if name is None else {"name": name}
        headers = {"content-type": "application/x-tar"}
        with path.open("rb") as file:
            answer = self._send("POST", "/v1/models/import", params=params, content=_chunks(file), headers=headers)
        return Version.model_validate(answer)

    def _send(self, method: str, path: str, **request: Any) -> Any:
        with self._reached():
            answer = self._http.request(method, path, **request)
        if not answer.is_success:
            raise _refused(answer)
        return answer.json() if answer.content else None

    @contextmanager
    def _reached(self) -> Iterator[None]:
        try:
            yield
        except httpx.TransportError as error:
            raise ServiceUnreachableError(
                f"no service answers at {self.url} ({error}): start one with `lipserve serve`"
            ) from error


def _refused(answer: httpx.Response) -> ApiError:
    """The error that an answer tells."""
    try:
        body = answer.json()["error"]
        return ApiError(answer.status_code, body["code"], body["message"], body["detail"])
    except (ValueError, KeyError, TypeError):
        return ApiError(answer.status_code, "http_error", answer.text[:500], [])


def _named(version: int | None, alias: str | None) -> dict[str, Any]:
    """The fields of a body that name a version."""
    return {name: value for name, value in (("version", version), ("alias", alias)) if value is not None}


def _chunks(file: Any) -> Iterator[bytes]:
    while chunk := file.read(1 << 20):
        yield chunk
