"""What a client asks and how it reads the answer, without any transport: each route of the API is one function.

`route` makes such a function of one that says what goes into a request; `Client` and `AsyncClient` are made of them.
"""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import wraps
from pathlib import Path
from secrets import token_hex
from threading import Lock
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar
from urllib.parse import quote

import msgspec

from lipserve.records import Record

P = ParamSpec("P")
T = TypeVar("T")
R = TypeVar("R", bound=Record)

ROUTES: dict[tuple[str, str], str] = {}
"""(method, path as in the OpenAPI document) of every route that there is a call of, and the call's name."""


@dataclass(frozen=True)
class Answer:
    """What came back. body: of the whole answer, or the data of one server-sent event, whose kind is `event`; empty
    where it was written to a file."""

    status: int
    body: bytes
    headers: Mapping[str, str] = field(default_factory=dict)
    event: str = ""


@dataclass(frozen=True, kw_only=True)
class Call(Generic[T]):
    """One request, and `read`, which makes its result of the answer.

    path: filled in and quoted; json: body as JSON; file: body as the bytes of a file; repeatable: whether it
    may be sent again when its answer is lost; removes: repeated, it has succeeded where nothing is found any more;
    timeout: longest wait for the answer in s, that of the client where None; save_to: file that the answer is written
    to, whole or not at all; shown: what a progress bar says, none where None.
    """

    method: str
    path: str
    read: Callable[[Answer], T]
    params: Mapping[str, Any] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    json: Any = None
    file: Path | None = None
    repeatable: bool = False
    removes: bool = False
    timeout: float | None = None
    save_to: Path | None = None
    shown: str | None = None

    def after(self, cursor: str) -> Call[T]:
        """The same call for the page after another one."""
        return replace(self, params={**self.params, "cursor": cursor})


@dataclass(frozen=True)
class Page(Generic[T]):
    """Part of a list. following: cursor of the next part, None on the last."""

    items: list[T]
    following: str | None


@dataclass(frozen=True)
class Route:
    """A method and the paths it goes to: of several the one whose names in braces are given."""

    method: str
    paths: tuple[str, ...]
    repeatable: bool

    def __call__(self, read: Callable[[Answer], T], *, names: Mapping[str, Any], **asked: Any) -> Call[T]:
        """Make the call. names: what stands for the names in braces, None where a name is not given; asked: see `Call`,
        `params` that are None are left out."""
        given = {name: str(value) for name, value in names.items() if value is not None}
        path = next(path for path in self.paths if set(_NAMES.findall(path)) == set(given))
        filled = path.format_map({name: quote(value, safe="") for name, value in given.items()})
        params = {name: value for name, value in asked.pop("params", {}).items() if value is not None}
        return Call(
            method=self.method, path=filled, read=read, params=params, **{"repeatable": self.repeatable, **asked}
        )


_NAMES = re.compile(r"{(\w+)}")


def route(
    method: str, *paths: str, repeatable: bool | None = None
) -> Callable[[Callable[Concatenate[Route, P], Call[T]]], Callable[P, Call[T]]]:
    """Make a call of a function that is given its route first.

    repeatable: whether it may be sent again when its answer is lost; where None, what is no POST may.
    """
    at = Route(method, paths, method != "POST" if repeatable is None else repeatable)

    def decorate(make: Callable[Concatenate[Route, P], Call[T]]) -> Callable[P, Call[T]]:
        @wraps(make)
        def made(*args: P.args, **kwargs: P.kwargs) -> Call[T]:
            return make(at, *args, **kwargs)

        signature = inspect.signature(make)
        _, *rest = signature.parameters.values()
        made.__signature__ = signature.replace(parameters=rest)  # type: ignore[attr-defined]  # what `help` shows
        for path in paths:
            ROUTES[method, path] = make.__name__
        return made

    return decorate


_making = Lock()


class _Listed(msgspec.Struct, Generic[T]):
    items: list[T]
    next_cursor: str | None = None


def decoder(kind: type[T], hook: Callable[[Any, Any], Any] | None = None) -> msgspec.json.Decoder[T]:
    """What decodes JSON as a type. hook: as `dec_hook` of msgspec, for what msgspec does not know.

    Made by one thread at a time: two that are the first to use a type of msgspec at once can end the process (SIGSEGV).
    """
    with _making:
        return msgspec.json.Decoder(kind, dec_hook=hook)


def record(kind: type[R]) -> Callable[[Answer], R]:
    """Read a record of the API."""
    decode = decoder(kind).decode
    return lambda answer: decode(answer.body)


def page(kind: type[R]) -> Callable[[Answer], Page[R]]:
    """Read one page of a list of records."""
    decode = decoder(_Listed[kind]).decode  # type: ignore[valid-type]

    def read(answer: Answer) -> Page[R]:
        listed: _Listed[R] = decode(answer.body)
        return Page(listed.items, listed.next_cursor)

    return read


def document(answer: Answer) -> Any:
    """Read JSON as it is."""
    return json.loads(answer.body)


def nothing(answer: Answer) -> None:
    """Read an answer that says nothing."""


def given(**values: Any) -> dict[str, Any]:
    """Those of the values that are not None."""
    return {name: value for name, value in values.items() if value is not None}


_RESULT = re.compile(r"Call\[(?:Page\[(?P<item>.+)\]|(?P<one>.+))\]")


def bound(method: Callable[P, T], result: str = "{}") -> Callable[P, T]:
    """Give a function that wraps a call's the signature of a method, and return it.

    result: what it returns, with {} for what the call makes or its page lists.
    """
    own = inspect.signature(method)
    itself = inspect.Parameter("self", inspect.Parameter.POSITIONAL_ONLY)
    made = _RESULT.fullmatch(str(own.return_annotation))
    returned = result.format(made["item"] or made["one"]) if made else own.return_annotation
    parameters = [itself, *own.parameters.values()]
    method.__signature__ = own.replace(  # type: ignore[attr-defined]
        parameters=parameters, return_annotation=returned
    )
    return method


KEY_HEADER = "Idempotency-Key"


def new_key() -> str:
    """A key that no other request has."""
    return token_hex(16)
