"""The client of programs that wait for what they ask."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import wraps
from pathlib import Path
from types import TracebackType
from typing import Any, Concatenate, ParamSpec, Self, TypeVar

import httpx

from service.client import calls
from service.client.call import Answer, Call, Page, bound
from service.client.sending import (
    RETRIES,
    Address,
    ApiError,
    Attempts,
    Events,
    Reach,
    ServiceUnreachableError,
    answer_of,
    draft_of,
    headers_of,
    pieces,
    request_of,
)
from service.client.stream import StreamClient
from service.foundation.settings import DEFAULT_URL
from service.foundation.states import ACTIVE
from service.learning.control.schema import Learning
from service.training.schema import Job

P = ParamSpec("P")
T = TypeVar("T")

POLL_SECONDS = 0.3


def _sync(make: Callable[P, Call[T]]) -> Callable[Concatenate[Client, P], T]:
    """A method that makes a call and returns its result."""

    @wraps(make)
    def method(self: Client, /, *args: P.args, **kwargs: P.kwargs) -> T:
        return self.send(make(*args, **kwargs))

    return bound(method)


def _listed(make: Callable[P, Call[Page[T]]]) -> Callable[Concatenate[Client, P], Iterator[T]]:
    """A method that makes a call and yields the items of all pages, each page when it is needed."""

    @wraps(make)
    def method(self: Client, /, *args: P.args, **kwargs: P.kwargs) -> Iterator[T]:
        call: Call[Page[T]] | None = make(*args, **kwargs)
        while call is not None:
            page = self.send(call)
            yield from page.items
            call = None if page.following is None else call.after(page.following)

    return bound(method, "Iterator[{}]")


def _followed(make: Callable[P, Call[T]]) -> Callable[Concatenate[Client, P], Iterator[T]]:
    """A method that makes a call and yields its server-sent events."""

    @wraps(make)
    def method(self: Client, /, *args: P.args, **kwargs: P.kwargs) -> Iterator[T]:
        return self.follow(make(*args, **kwargs))

    return bound(method, "Iterator[{}]")


class Client:
    """Synchronous client; use it as a context manager or close it. Threads may share it.

    url: http://host:port, or unix:///path of the service's Unix-domain socket; timeout: longest wait for an answer, s;
    key: API key, that of the environment variable LIPSERVE_KEY where None; retries: most repetitions of a call that may
    be repeated, where the connection is lost or the service asks to come back; uploads and jobs carry an identity, so
    that a repetition does not do them twice.
    Methods raise ServiceUnreachableError where no service answers, ApiError where it refuses.
    """

    def __init__(
        self, url: str = DEFAULT_URL, timeout: float = 120.0, key: str | None = None, retries: int = RETRIES
    ) -> None:
        self.url, self._key, self._address = url, key, Address.of(url)
        self._reach = Reach(url, retries)
        unix = self._address.unix
        self._http = httpx.Client(
            base_url=self._address.base,
            timeout=timeout,
            transport=None if unix is None else httpx.HTTPTransport(uds=str(unix)),
            headers=headers_of(key),
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

    upload = _sync(calls.datasets.upload)
    datasets = _listed(calls.datasets.datasets)
    dataset = _sync(calls.datasets.dataset)
    preview = _sync(calls.datasets.preview)
    delete_dataset = _sync(calls.datasets.delete_dataset)
    upload_robot = _sync(calls.datasets.upload_robot)
    robots = _listed(calls.datasets.robots)
    robot = _sync(calls.datasets.robot)
    delete_robot = _sync(calls.datasets.delete_robot)
    profiles = _sync(calls.datasets.profiles)
    profile = _sync(calls.datasets.profile)

    train = _sync(calls.models.train)
    jobs = _listed(calls.models.jobs)
    job = _sync(calls.models.job)
    job_events = _followed(calls.models.job_events)
    cancel = _sync(calls.models.cancel)
    retry = _sync(calls.models.retry)

    models = _listed(calls.models.models)
    model = _sync(calls.models.model)
    delete_model = _sync(calls.models.delete_model)
    version = _sync(calls.models.version)
    delete_version = _sync(calls.models.delete_version)
    aliases = _sync(calls.models.aliases)
    set_alias = _sync(calls.models.set_alias)
    remove_alias = _sync(calls.models.remove_alias)
    rollback_alias = _sync(calls.models.rollback_alias)
    export = _sync(calls.models.export)
    urdf = _sync(calls.models.urdf)
    import_model = _sync(calls.models.import_model)

    predict = _sync(calls.inference.predict)
    evaluate = _sync(calls.inference.evaluate)
    compare = _sync(calls.inference.compare)
    trace = _sync(calls.inference.trace)

    observe = _sync(calls.learning.observe)
    observations = _listed(calls.learning.observations)
    observation = _sync(calls.learning.observation)
    unlearn = _sync(calls.learning.unlearn)
    replay = _sync(calls.learning.replay)
    rollback = _sync(calls.learning.rollback)
    refresh = _sync(calls.learning.refresh)
    quality = _sync(calls.learning.quality)
    learning = _sync(calls.learning.learning)
    put_learning = _sync(calls.learning.put_learning)
    decide = _sync(calls.learning.decide)
    alarms = _listed(calls.learning.alarms)
    live = _followed(calls.learning.live)

    health = _sync(calls.inference.health)
    live_health = _sync(calls.inference.live_health)
    metrics = _sync(calls.inference.metrics)
    echo = _sync(calls.inference.echo)
    server_metadata = _sync(calls.inference.server_metadata)
    server_live = _sync(calls.inference.server_live)
    server_ready = _sync(calls.inference.server_ready)
    model_metadata = _sync(calls.inference.model_metadata)
    model_ready = _sync(calls.inference.model_ready)
    infer = _sync(calls.inference.infer)

    def ready(self) -> bool:
        """Whether the service can answer queries now."""
        try:
            self.health()
        except (ApiError, ServiceUnreachableError):
            return False
        return True

    def wait(self, job: str | Job, on_progress: Callable[[Job], None] | None = None, *, progress: bool = False) -> Job:
        """Wait for a job's end, however it ends; on_progress is called with every look at it, progress: show a bar."""
        with ExitStack() as stack:
            looks = [] if on_progress is None else [on_progress]
            if progress:
                from service.client.progress import job_bar  # noqa: PLC0415 - rich, for those who look

                looks.append(stack.enter_context(job_bar()))
            while True:
                seen = self.job(job if isinstance(job, str) else job.id)
                for look in looks:
                    look(seen)
                if seen.state not in ACTIVE:
                    return seen
                time.sleep(POLL_SECONDS)

    def set_learning(self, model: str, **options: Any) -> Learning:
        """Set how a model learns; options of `LearningOptions` by name, those left out keep their values."""
        return self.put_learning(model, {**self.learning(model).options.model_dump(), **options})

    def stream(self, model: str, **options: Any) -> StreamClient:
        """Open a torque stream; options: those of `StreamClient` but for the address and the key."""
        return StreamClient(model, self._address.base, self._address.unix, key=self._key, **options)

    def send(self, call: Call[T]) -> T:
        """Make a call and return its result; repeat it where that is safe and helps."""
        attempts = Attempts(call, self._reach)
        while True:
            try:
                answer = self._exchange(call)
            except httpx.TransportError as error:
                pause: float | None = attempts.lost(error)
            else:
                pause = attempts.answered(answer)
            if pause is None:
                return call.read(answer)
            time.sleep(pause)

    def follow(self, call: Call[T]) -> Iterator[T]:
        """Make a call and yield what its server-sent events say, until the service ends them.

        The start is repeated as that of any other call; where the connection is lost later, ServiceUnreachableError
        is raised: ask again then.
        """
        attempts, begun = Attempts(call, self._reach), False
        while not begun:
            try:
                with self._http.stream(**request_of(call)) as response:
                    pause = attempts.answered(answer_of(response, b"" if response.is_success else response.read()))
                    if pause is None:
                        begun, events = True, Events()
                        for line in response.iter_lines():
                            if (event := events.take(line)) is not None:
                                yield call.read(event)
            except httpx.TransportError as error:
                if begun:
                    raise ServiceUnreachableError(f"the service at {self.url} is lost ({error})") from error
                pause = attempts.lost(error)
            if pause is not None:
                time.sleep(pause)

    def _exchange(self, call: Call[Any]) -> Answer:
        """Make one attempt at a call."""
        if call.save_to is not None:
            return self._save(call, call.save_to)
        if call.file is None:
            response = self._http.request(**request_of(call))
        else:
            with ExitStack() as stack:
                content = pieces(stack.enter_context(call.file.open("rb")))
                if call.shown is not None:
                    from service.client.progress import upload_bar  # noqa: PLC0415 - rich, for those who look

                    content = stack.enter_context(upload_bar(call.shown, call.file.stat().st_size))(content)
                response = self._http.request(**request_of(call), content=content)
        return answer_of(response, response.content)

    def _save(self, call: Call[Any], path: Path) -> Answer:
        draft = draft_of(path)
        try:
            with self._http.stream(**request_of(call)) as response:
                if not response.is_success:
                    return answer_of(response, response.read())
                with draft.open("wb") as file:
                    for piece in response.iter_bytes():
                        file.write(piece)
            draft.replace(path)
        finally:
            draft.unlink(missing_ok=True)
        return answer_of(response)
