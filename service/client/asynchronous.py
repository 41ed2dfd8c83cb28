"""The client of programs that do something else meanwhile: the same calls, awaited."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from contextlib import ExitStack
from functools import wraps
from pathlib import Path
from types import TracebackType
from typing import Any, Concatenate, ParamSpec, Self, TypeVar

import httpx

from service.client import calls
from service.client.async_stream import AsyncStreamClient
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
from service.client.sync import POLL_SECONDS
from service.foundation.settings import DEFAULT_URL
from service.foundation.states import ACTIVE
from service.learning.control.schema import Learning
from service.training.schema import Job

P = ParamSpec("P")
T = TypeVar("T")


def _async(make: Callable[P, Call[T]]) -> Callable[Concatenate[AsyncClient, P], Coroutine[Any, Any, T]]:
    """A method that makes a call and returns its result."""

    @wraps(make)
    async def method(self: AsyncClient, /, *args: P.args, **kwargs: P.kwargs) -> T:
        return await self.send(make(*args, **kwargs))

    return bound(method)


def _listed(make: Callable[P, Call[Page[T]]]) -> Callable[Concatenate[AsyncClient, P], AsyncIterator[T]]:
    """A method that makes a call and yields the items of all pages, each page when it is needed."""

    @wraps(make)
    async def method(self: AsyncClient, /, *args: P.args, **kwargs: P.kwargs) -> AsyncIterator[T]:
        call: Call[Page[T]] | None = make(*args, **kwargs)
        while call is not None:
            page = await self.send(call)
            for item in page.items:
                yield item
            call = None if page.following is None else call.after(page.following)

    return bound(method, "AsyncIterator[{}]")


def _followed(make: Callable[P, Call[T]]) -> Callable[Concatenate[AsyncClient, P], AsyncIterator[T]]:
    """A method that makes a call and yields its server-sent events."""

    @wraps(make)
    def method(self: AsyncClient, /, *args: P.args, **kwargs: P.kwargs) -> AsyncIterator[T]:
        return self.follow(make(*args, **kwargs))

    return bound(method, "AsyncIterator[{}]")


class AsyncClient:
    """Asynchronous client, for asyncio; use it as an asynchronous context manager or close it.

    Arguments and errors are those of `Client`, and so are the methods: they are awaited, lists and events are
    asynchronous iterators.
    """

    def __init__(
        self, url: str = DEFAULT_URL, timeout: float = 120.0, key: str | None = None, retries: int = RETRIES
    ) -> None:
        self.url, self._key, self._address = url, key, Address.of(url)
        self._reach = Reach(url, retries)
        unix = self._address.unix
        self._http = httpx.AsyncClient(
            base_url=self._address.base,
            timeout=timeout,
            transport=None if unix is None else httpx.AsyncHTTPTransport(uds=str(unix)),
            headers=headers_of(key),
        )

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    upload = _async(calls.datasets.upload)
    datasets = _listed(calls.datasets.datasets)
    dataset = _async(calls.datasets.dataset)
    preview = _async(calls.datasets.preview)
    delete_dataset = _async(calls.datasets.delete_dataset)
    upload_robot = _async(calls.datasets.upload_robot)
    robots = _listed(calls.datasets.robots)
    robot = _async(calls.datasets.robot)
    delete_robot = _async(calls.datasets.delete_robot)
    profiles = _async(calls.datasets.profiles)
    profile = _async(calls.datasets.profile)

    train = _async(calls.models.train)
    jobs = _listed(calls.models.jobs)
    job = _async(calls.models.job)
    job_events = _followed(calls.models.job_events)
    cancel = _async(calls.models.cancel)
    retry = _async(calls.models.retry)

    models = _listed(calls.models.models)
    model = _async(calls.models.model)
    delete_model = _async(calls.models.delete_model)
    version = _async(calls.models.version)
    delete_version = _async(calls.models.delete_version)
    aliases = _async(calls.models.aliases)
    set_alias = _async(calls.models.set_alias)
    remove_alias = _async(calls.models.remove_alias)
    rollback_alias = _async(calls.models.rollback_alias)
    export = _async(calls.models.export)
    urdf = _async(calls.models.urdf)
    import_model = _async(calls.models.import_model)

    predict = _async(calls.inference.predict)
    evaluate = _async(calls.inference.evaluate)
    compare = _async(calls.inference.compare)
    trace = _async(calls.inference.trace)

    observe = _async(calls.learning.observe)
    observations = _listed(calls.learning.observations)
    observation = _async(calls.learning.observation)
    unlearn = _async(calls.learning.unlearn)
    replay = _async(calls.learning.replay)
    rollback = _async(calls.learning.rollback)
    refresh = _async(calls.learning.refresh)
    quality = _async(calls.learning.quality)
    learning = _async(calls.learning.learning)
    put_learning = _async(calls.learning.put_learning)
    decide = _async(calls.learning.decide)
    alarms = _listed(calls.learning.alarms)
    live = _followed(calls.learning.live)

    health = _async(calls.inference.health)
    live_health = _async(calls.inference.live_health)
    metrics = _async(calls.inference.metrics)
    echo = _async(calls.inference.echo)
    server_metadata = _async(calls.inference.server_metadata)
    server_live = _async(calls.inference.server_live)
    server_ready = _async(calls.inference.server_ready)
    model_metadata = _async(calls.inference.model_metadata)
    model_ready = _async(calls.inference.model_ready)
    infer = _async(calls.inference.infer)

    async def ready(self) -> bool:
        """Whether the service can answer queries now."""
        try:
            await self.health()
        except (ApiError, ServiceUnreachableError):
            return False
        return True

    async def wait(
        self, job: str | Job, on_progress: Callable[[Job], None] | None = None, *, progress: bool = False
    ) -> Job:
        """Wait for a job's end, however it ends; on_progress is called with every look at it, progress: show a bar."""
        with ExitStack() as stack:
            looks = [] if on_progress is None else [on_progress]
            if progress:
                from service.client.progress import job_bar  # noqa: PLC0415 - rich, for those who look

                looks.append(stack.enter_context(job_bar()))
            while True:
                seen = await self.job(job if isinstance(job, str) else job.id)
                for look in looks:
                    look(seen)
                if seen.state not in ACTIVE:
                    return seen
                await asyncio.sleep(POLL_SECONDS)

    async def set_learning(self, model: str, **options: Any) -> Learning:
        """Set how a model learns; options of `LearningOptions` by name, those left out keep their values."""
        known = await self.learning(model)
        return await self.put_learning(model, {**known.options.model_dump(), **options})

    def stream(self, model: str, **options: Any) -> AsyncStreamClient:
        """A torque stream, to be opened with `async with`; options: those of `AsyncStreamClient` but for the address
        and the key."""
        return AsyncStreamClient(model, self._address.base, self._address.unix, key=self._key, **options)

    async def send(self, call: Call[T]) -> T:
        """Make a call and return its result; repeat it where that is safe and helps."""
        attempts = Attempts(call, self._reach)
        while True:
            try:
                answer = await self._exchange(call)
            except httpx.TransportError as error:
                pause: float | None = attempts.lost(error)
            else:
                pause = attempts.answered(answer)
            if pause is None:
                return call.read(answer)
            await asyncio.sleep(pause)

    async def follow(self, call: Call[T]) -> AsyncIterator[T]:
        """Make a call and yield what its server-sent events say, until the service ends them; as `Client.follow`."""
        attempts, begun = Attempts(call, self._reach), False
        while not begun:
            try:
                async with self._http.stream(**request_of(call)) as response:
                    body = b"" if response.is_success else await response.aread()
                    pause = attempts.answered(answer_of(response, body))
                    if pause is None:
                        begun, events = True, Events()
                        async for line in response.aiter_lines():
                            if (event := events.take(line)) is not None:
                                yield call.read(event)
            except httpx.TransportError as error:
                if begun:
                    raise ServiceUnreachableError(f"the service at {self.url} is lost ({error})") from error
                pause = attempts.lost(error)
            if pause is not None:
                await asyncio.sleep(pause)

    async def _exchange(self, call: Call[Any]) -> Answer:
        """Make one attempt at a call."""
        if call.save_to is not None:
            return await self._save(call, call.save_to)
        if call.file is None:
            response = await self._http.request(**request_of(call))
        else:
            with ExitStack() as stack:
                content = pieces(stack.enter_context(call.file.open("rb")))
                if call.shown is not None:
                    from service.client.progress import upload_bar  # noqa: PLC0415 - rich, for those who look

                    content = stack.enter_context(upload_bar(call.shown, call.file.stat().st_size))(content)
                response = await self._http.request(**request_of(call), content=_awaited(content))
        return answer_of(response, response.content)

    async def _save(self, call: Call[Any], path: Path) -> Answer:
        draft = draft_of(path)
        try:
            async with self._http.stream(**request_of(call)) as response:
                if not response.is_success:
                    return answer_of(response, await response.aread())
                with draft.open("wb") as file:
                    async for piece in response.aiter_bytes():
                        await asyncio.to_thread(file.write, piece)
            draft.replace(path)
        finally:
            draft.unlink(missing_ok=True)
        return answer_of(response)


async def _awaited(content: Iterator[bytes]) -> AsyncIterator[bytes]:
    """Pieces of a file, read in a thread: a disk may be slow."""
    while (piece := await asyncio.to_thread(next, content, None)) is not None:
        yield piece
