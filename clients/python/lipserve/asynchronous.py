"""Asynchronous client."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from functools import wraps
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, Self, TypeVar

import httpx
import numpy as np
from numpy.typing import ArrayLike

from lipserve import sending
from lipserve.asynchronous_stream import AsyncStreamClient
from lipserve.call import Answer, Call, Page, bound
from lipserve.methods import POLL_SECONDS, Calls, Followed, Listed, One, reporting
from lipserve.records.jobs import Job
from lipserve.records.learning import Learning
from lipserve.results.series import Component

P = ParamSpec("P")
T = TypeVar("T")


def _async(make: Callable[P, Call[T]]) -> Callable[Concatenate[AsyncClient, P], Coroutine[Any, Any, T]]:
    @wraps(make)
    async def method(self: AsyncClient, /, *args: P.args, **kwargs: P.kwargs) -> T:
        return await self.send(make(*args, **kwargs))

    return bound(method)


def _listed(make: Callable[P, Call[Page[T]]]) -> Callable[Concatenate[AsyncClient, P], AsyncIterator[T]]:
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
    @wraps(make)
    def method(self: AsyncClient, /, *args: P.args, **kwargs: P.kwargs) -> AsyncIterator[T]:
        return self.follow(make(*args, **kwargs))

    return bound(method, "AsyncIterator[{}]")


class AsyncClient(Calls, makers={One: _async, Listed: _listed, Followed: _followed}):
    """Asynchronous client for asyncio. Use it as an asynchronous context manager, or close it.

    Arguments, methods and errors are those of `Client`. Methods are awaited; lists and events are asynchronous
    iterators.

    Example:
        >>> async def torque():
        ...     async with AsyncClient() as client:
        ...         return await client.predict("panda-sim", [0.0] * 7, [0.0] * 7, [0.0] * 7)
    """

    _http: httpx.AsyncClient

    def _connected(self, uds: str | None, **options: Any) -> httpx.AsyncClient:
        return httpx.AsyncClient(transport=None if uds is None else httpx.AsyncHTTPTransport(uds=uds), **options)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close all connections."""
        await self._http.aclose()

    async def ready(self) -> bool:
        """Return whether the service can answer queries now."""
        try:
            await self.health()
        except (sending.ApiError, sending.ServiceUnreachableError):
            return False
        return True

    async def wait(
        self, job: str | Job, on_progress: Callable[[Job], None] | None = None, *, progress: bool = False
    ) -> Job:
        """Wait until a job has ended, and return it; see `Client.wait`."""
        name = job if isinstance(job, str) else job.id
        with reporting(on_progress, progress) as report:
            while not report(seen := await self.job(name)):
                await asyncio.sleep(POLL_SECONDS)
        return seen

    async def mass_matrix(self, model: str, q: ArrayLike, **options: Any) -> Component:
        """Return the inertia matrix M(q) at one or N postures, (…, n, n), rotors included. Options: those of `predict`.

        Example:
            >>> client.mass_matrix("panda-sim", [0.0] * 7).mean
        """
        rest = np.zeros_like(q, np.float64)
        answer = await self.predict(model, q, rest, rest, components=["inertia_matrix"], **options)
        assert answer.components is not None
        return answer.components["inertia_matrix"]

    async def coriolis(self, model: str, q: ArrayLike, dq: ArrayLike, **options: Any) -> Component:
        """Return the Coriolis and centrifugal torque c(q, dq) at one or N states, (…, n). Options: those of `predict`.

        Example:
            >>> client.coriolis("panda-sim", [0.0] * 7, [0.1] * 7).mean
        """
        answer = await self.predict(model, q, dq, np.zeros_like(q, np.float64), components=["coriolis"], **options)
        assert answer.components is not None
        return answer.components["coriolis"]

    async def set_learning(self, model: str, **options: Any) -> Learning:
        """Set learning options of a model by name; others keep their values. Names: see `LearningOptions`."""
        known = await self.learning(model)
        return await self.put_learning(model, {**known.options.as_dict(), **options})

    def stream(self, model: str, **options: Any) -> AsyncStreamClient:
        """Return a torque stream; open it with `async with`.

        Options: those of `AsyncStreamClient`, except address and key.
        """
        return AsyncStreamClient(model, self._address.base, self._address.unix, key=self._key, **options)

    async def send(self, call: Call[T]) -> T:
        """Send a call and return its result; repeat it if that is safe and useful."""
        attempts = sending.Attempts(call, self._reach)
        while True:
            try:
                answer = await self._exchange(call)
            except httpx.TransportError as error:
                pause: float | None = attempts.after_error(error)
            else:
                pause = attempts.after_answer(answer)
            if pause is None:
                return sending.result_of(call, answer)
            await asyncio.sleep(pause)

    async def follow(self, call: Call[T]) -> AsyncIterator[T]:
        """Send a call and yield its server-sent events until the service ends them; see `Client.follow`."""
        attempts, begun = sending.Attempts(call, self._reach), False
        while not begun:
            try:
                async with self._http.stream(**sending.request_of(call)) as response:
                    body = b"" if response.is_success else await response.aread()
                    pause = attempts.after_answer(sending.answer_of(response, body))
                    if pause is None:
                        begun, events = True, sending.Events()
                        async for line in response.aiter_lines():
                            if (event := events.add_line(line)) is not None:
                                yield sending.result_of(call, event)
            except httpx.TransportError as error:
                pause = attempts.after_error(error, begun)
            if pause is not None:
                await asyncio.sleep(pause)

    async def _exchange(self, call: Call[Any]) -> Answer:
        """Send a call once."""
        if call.save_to is not None:
            return await self._save(call, call.save_to)
        with sending.content_of(call) as content:
            awaited = None if content is None else _awaited(content)
            response = await self._http.request(**sending.request_of(call), content=awaited)
        return sending.answer_of(response, response.content)

    async def _save(self, call: Call[Any], path: Path) -> Answer:
        async with self._http.stream(**sending.request_of(call)) as response:
            if not response.is_success:
                return sending.answer_of(response, await response.aread())
            with sending.drafted(path) as file:
                async for piece in response.aiter_bytes():
                    await asyncio.to_thread(file.write, piece)
        return sending.answer_of(response)


async def _awaited(content: Iterator[bytes]) -> AsyncIterator[bytes]:
    """Yield pieces of a file, read in a thread because a disk may be slow."""
    while (piece := await asyncio.to_thread(next, content, None)) is not None:
        yield piece
