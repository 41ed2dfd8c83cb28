"""Base of both clients: a method for every call, connection settings, waiting for jobs."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any, Generic, ParamSpec, TypeVar, overload

from lipserve import calls
from lipserve.address import Address, headers_of, url_of
from lipserve.call import Call, Page
from lipserve.records.jobs import Job
from lipserve.sending import RETRIES, Reach
from lipserve.states import ACTIVE

if TYPE_CHECKING:
    from lipserve.asynchronous import AsyncClient
    from lipserve.sync import Client

P = ParamSpec("P")
T = TypeVar("T")

POLL_SECONDS = 0.3


class One(Generic[P, T]):
    """Method that returns the result of a call; in `AsyncClient` it is awaited."""

    def __init__(self, make: Callable[P, Call[T]]) -> None:
        self.make = make

    @overload
    def __get__(self, client: Client, owner: Any = None) -> Callable[P, T]: ...
    @overload
    def __get__(self, client: AsyncClient, owner: Any = None) -> Callable[P, Coroutine[Any, Any, T]]: ...
    def __get__(self, client: Any, owner: Any = None) -> Any:
        """Declare the type only: `Calls` replaces these objects by functions."""
        raise NotImplementedError


class _Many(Generic[P, T]):
    @overload
    def __get__(self, client: Client, owner: Any = None) -> Callable[P, Iterator[T]]: ...
    @overload
    def __get__(self, client: AsyncClient, owner: Any = None) -> Callable[P, AsyncIterator[T]]: ...
    def __get__(self, client: Any, owner: Any = None) -> Any:
        """Declare the type only, as in `One`."""
        raise NotImplementedError


class Listed(_Many[P, T]):
    """Method that yields the items of all pages; pages are requested when they are needed."""

    def __init__(self, make: Callable[P, Call[Page[T]]]) -> None:
        self.make = make


class Followed(_Many[P, T]):
    """Method that yields the server-sent events of a call."""

    def __init__(self, make: Callable[P, Call[T]]) -> None:
        self.make = make


class Calls:
    """Base class of clients; its members become methods of a subclass, made by the subclass's `makers`.

    Arguments: see `Client`.
    """

    def __init_subclass__(cls, makers: dict[type, Callable[[Any], Any]]) -> None:
        for name, member in vars(Calls).items():
            if type(member) in makers:
                setattr(cls, name, makers[type(member)](member.make))

    def __init__(
        self, url: str | None = None, timeout: float = 120.0, key: str | None = None, retries: int = RETRIES
    ) -> None:
        self.url = url_of(url)
        self._key, self._address = key, Address.of(self.url)
        self._reach = Reach(self.url, retries)
        uds = None if self._address.unix is None else str(self._address.unix)
        self._http = self._connected(uds, base_url=self._address.base, timeout=timeout, headers=headers_of(key))

    def _connected(self, uds: str | None, **options: Any) -> Any:
        """Return a client of httpx. uds: path of a Unix-domain socket, None for host and port."""
        raise NotImplementedError

    upload = One(calls.datasets.upload)
    datasets = Listed(calls.datasets.datasets)
    dataset = One(calls.datasets.dataset)
    preview = One(calls.datasets.preview)
    read_again = One(calls.datasets.read_again)
    delete_dataset = One(calls.datasets.delete_dataset)
    upload_robot = One(calls.datasets.upload_robot)
    robots = Listed(calls.datasets.robots)
    robot = One(calls.datasets.robot)
    delete_robot = One(calls.datasets.delete_robot)
    profiles = One(calls.datasets.profiles)
    profile = One(calls.datasets.profile)

    train = One(calls.models.train)
    check_training = One(calls.models.check_training)
    jobs = Listed(calls.models.jobs)
    job = One(calls.models.job)
    job_events = Followed(calls.models.job_events)
    cancel = One(calls.models.cancel)
    retry = One(calls.models.retry)

    models = Listed(calls.models.models)
    overview = Listed(calls.models.overview)
    model = One(calls.models.model)
    delete_model = One(calls.models.delete_model)
    version = One(calls.models.version)
    annotate = One(calls.models.annotate)
    delete_version = One(calls.models.delete_version)
    aliases = One(calls.models.aliases)
    set_alias = One(calls.models.set_alias)
    set_thresholds = One(calls.models.set_thresholds)
    remove_alias = One(calls.models.remove_alias)
    rollback_alias = One(calls.models.rollback_alias)
    export = One(calls.models.export)
    import_model = One(calls.models.import_model)
    audit = Listed(calls.models.audit)

    predict = One(calls.inference.predict)
    gravity = One(calls.inference.gravity)
    wrench = One(calls.inference.wrench)
    evaluate = One(calls.inference.evaluate)
    compare = One(calls.inference.compare)
    trace = One(calls.inference.trace)

    observe = One(calls.learning.observe)
    observations = Listed(calls.learning.observations)
    observation = One(calls.learning.observation)
    unlearn = One(calls.learning.unlearn)
    replay = One(calls.learning.replay)
    rollback = One(calls.learning.rollback)
    refresh = One(calls.learning.refresh)
    quality = One(calls.learning.quality)
    learning = One(calls.learning.learning)
    put_learning = One(calls.learning.put_learning)
    decide = One(calls.learning.decide)
    payload = One(calls.learning.payload)
    declare_payload = One(calls.learning.declare_payload)
    remove_payload = One(calls.learning.remove_payload)
    delete_stream = One(calls.learning.delete_stream)
    alarms = Listed(calls.learning.alarms)
    live = Followed(calls.learning.live)

    abilities = One(calls.inference.abilities)
    health = One(calls.inference.health)
    live_health = One(calls.inference.live_health)
    metrics = One(calls.inference.metrics)
    echo = One(calls.inference.echo)
    server_metadata = One(calls.inference.server_metadata)
    server_live = One(calls.inference.server_live)
    server_ready = One(calls.inference.server_ready)
    model_metadata = One(calls.inference.model_metadata)
    model_ready = One(calls.inference.model_ready)
    infer = One(calls.inference.infer)


@contextmanager
def reporting(on_progress: Callable[[Job], None] | None, progress: bool) -> Iterator[Callable[[Job], bool]]:
    """Yield a function that reports a job's state to callback and progress bar, and returns whether it has ended."""
    with ExitStack() as stack:
        listeners = [] if on_progress is None else [on_progress]
        if progress:
            from lipserve.progress import job_bar  # noqa: PLC0415 - Rich is optional

            listeners.append(stack.enter_context(job_bar()))

        def report(job: Job) -> bool:
            for listener in listeners:
                listener(job)
            return job.state not in ACTIVE

        yield report
