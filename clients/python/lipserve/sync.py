"""Synchronous client."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import wraps
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, Self, TypeVar

import httpx
import numpy as np
from numpy.typing import ArrayLike

from lipserve import sending
from lipserve.call import Answer, Call, Page, bound
from lipserve.methods import POLL_SECONDS, Calls, Followed, Listed, One, reporting
from lipserve.records.jobs import Job
from lipserve.records.learning import Learning
from lipserve.results.series import Component
from lipserve.stream import StreamClient

P = ParamSpec("P")
T = TypeVar("T")


def _sync(make: Callable[P, Call[T]]) -> Callable[Concatenate[Client, P], T]:
    @wraps(make)
    def method(self: Client, /, *args: P.args, **kwargs: P.kwargs) -> T:
        return self.send(make(*args, **kwargs))

    return bound(method)


def _listed(make: Callable[P, Call[Page[T]]]) -> Callable[Concatenate[Client, P], Iterator[T]]:
    @wraps(make)
    def method(self: Client, /, *args: P.args, **kwargs: P.kwargs) -> Iterator[T]:
        call: Call[Page[T]] | None = make(*args, **kwargs)
        while call is not None:
            page = self.send(call)
            yield from page.items
            call = None if page.following is None else call.after(page.following)

    return bound(method, "Iterator[{}]")


def _followed(make: Callable[P, Call[T]]) -> Callable[Concatenate[Client, P], Iterator[T]]:
    @wraps(make)
    def method(self: Client, /, *args: P.args, **kwargs: P.kwargs) -> Iterator[T]:
        return self.follow(make(*args, **kwargs))

    return bound(method, "Iterator[{}]")


class Client(Calls, makers={One: _sync, Listed: _listed, Followed: _followed}):
    """Synchronous client. Use it as a context manager, or close it. Threads may share it.

    Calls are repeated automatically if the connection is lost or the service asks to retry, but only if this is safe.
    Uploads and jobs carry an idempotency key, so a repetition does not run them twice.

    Args:
        url: http://host:port, or unix:///path of a Unix-domain socket. Default: the environment variable
            LIPSERVE_URL, else http://127.0.0.1:8000.
        timeout: Max time to wait for an answer, s.
        key: API key. Default: the environment variable LIPSERVE_API_KEY.
        retries: Max number of repetitions of a call.

    Raises:
        ServiceUnreachableError: By all methods, if the service does not answer.
        ApiError: By all methods, if the service rejects the request.

    Example:
        >>> with Client("http://127.0.0.1:8000") as client:
        ...     answer = client.predict("panda-sim", [0.0] * 7, [0.0] * 7, [0.0] * 7)
        >>> answer.tau.shape, answer.tau_std.shape
        ((7,), (7,))
    """

    _http: httpx.Client

    def _connected(self, uds: str | None, **options: Any) -> httpx.Client:
        return httpx.Client(transport=None if uds is None else httpx.HTTPTransport(uds=uds), **options)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all connections."""
        self._http.close()

    def ready(self) -> bool:
        """Return whether the service can answer queries now."""
        try:
            self.health()
        except (sending.ApiError, sending.ServiceUnreachableError):
            return False
        return True

    def wait(self, job: str | Job, on_progress: Callable[[Job], None] | None = None, *, progress: bool = False) -> Job:
        """Wait until a job has ended, and return it.

        The job may have succeeded, failed or been cancelled: check its `state`.

        Args:
            job: The job or its id.
            on_progress: Called with the job each time it is requested.
            progress: Show a progress bar (needs the extra `progress`).
        """
        name = job if isinstance(job, str) else job.id
        with reporting(on_progress, progress) as report:
            while not report(seen := self.job(name)):
                time.sleep(POLL_SECONDS)
        return seen

    def mass_matrix(self, model: str, q: ArrayLike, **options: Any) -> Component:
        """Return the inertia matrix M(q) at one or N postures, (…, n, n), rotors included. Options: those of `predict`.

        Example:
            >>> client.mass_matrix("panda-sim", [0.0] * 7).mean
        """
        rest = np.zeros_like(q, np.float64)
        answer = self.predict(model, q, rest, rest, components=["inertia_matrix"], **options)
        assert answer.components is not None
        return answer.components["inertia_matrix"]

    def coriolis(self, model: str, q: ArrayLike, dq: ArrayLike, **options: Any) -> Component:
        """Return the Coriolis and centrifugal torque c(q, dq) at one or N states, (…, n). Options: those of `predict`.

        Example:
            >>> client.coriolis("panda-sim", [0.0] * 7, [0.1] * 7).mean
        """
        answer = self.predict(model, q, dq, np.zeros_like(q, np.float64), components=["coriolis"], **options)
        assert answer.components is not None
        return answer.components["coriolis"]

    def set_learning(self, model: str, **options: Any) -> Learning:
        """Set learning options of a model by name; others keep their values. Names: see `LearningOptions`."""
        return self.put_learning(model, {**self.learning(model).options.as_dict(), **options})

    def stream(self, model: str, **options: Any) -> StreamClient:
        """Open a torque stream. Options: those of `StreamClient`, except address and key."""
        return StreamClient(model, self._address.base, self._address.unix, key=self._key, **options)

    def send(self, call: Call[T]) -> T:
        """Send a call and return its result; repeat it if that is safe and useful."""
        attempts = sending.Attempts(call, self._reach)
        while True:
            try:
                answer = self._exchange(call)
            except httpx.TransportError as error:
                pause: float | None = attempts.after_error(error)
            else:
                pause = attempts.after_answer(answer)
            if pause is None:
                return sending.result_of(call, answer)
            time.sleep(pause)

    def follow(self, call: Call[T]) -> Iterator[T]:
        """Send a call and yield its server-sent events until the service ends them.

        The start is repeated like other calls. If the connection is lost later, ServiceUnreachableError is raised:
        call again then.
        """
        attempts, begun = sending.Attempts(call, self._reach), False
        while not begun:
            try:
                with self._http.stream(**sending.request_of(call)) as response:
                    pause = attempts.after_answer(
                        sending.answer_of(response, b"" if response.is_success else response.read())
                    )
                    if pause is None:
                        begun, events = True, sending.Events()
                        for line in response.iter_lines():
                            if (event := events.add_line(line)) is not None:
                                yield sending.result_of(call, event)
            except httpx.TransportError as error:
                pause = attempts.after_error(error, begun)
            if pause is not None:
                time.sleep(pause)

    def _exchange(self, call: Call[Any]) -> Answer:
        """Send a call once."""
        if call.save_to is not None:
            return self._save(call, call.save_to)
        with sending.content_of(call) as content:
            response = self._http.request(**sending.request_of(call), content=content)
        return sending.answer_of(response, response.content)

    def _save(self, call: Call[Any], path: Path) -> Answer:
        with self._http.stream(**sending.request_of(call)) as response:
            if not response.is_success:
                return sending.answer_of(response, response.read())
            with sending.drafted(path) as file:
                for piece in response.iter_bytes():
                    file.write(piece)
        return sending.answer_of(response)
