"""Requests of the API and how to read their answers, without transport.

The decorator `route` turns a function that fills in a request into a function that returns a `Call`. `Client` and
`AsyncClient` turn these functions into methods.
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
"""Name of the call for each (method, path as in the OpenAPI document)."""


@dataclass(frozen=True)
class Answer:
    """Answer of the service, or one server-sent event of kind `event`; body is empty if it was saved to a file."""

    status: int
    body: bytes
    headers: Mapping[str, str] = field(default_factory=dict)
    event: str = ""


@dataclass(frozen=True, kw_only=True)
class Call(Generic[T]):
    """One request, and `read`, which converts its answer to the result."""

    method: str
    path: str
    """Path with quoted names."""
    read: Callable[[Answer], T]
    params: Mapping[str, Any] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    json: Any = None
    """Body as JSON."""
    file: Path | None = None
    """File that is the body."""
    repeatable: bool = False
    """Whether the request may be sent again if its answer is lost."""
    removes: bool = False
    """Whether 404 in a repeated request means success."""
    timeout: float | None = None
    """Max time to wait for the answer, s; the client's if None."""
    save_to: Path | None = None
    """File for the answer; it is written completely or not at all."""
    shown: str | None = None
    """Text of a progress bar; None for no bar."""

    def after(self, cursor: str) -> Call[T]:
        """Return the same call for the page at a cursor."""
        return replace(self, params={**self.params, "cursor": cursor})


@dataclass(frozen=True)
class Page(Generic[T]):
    """Page of a list. following: cursor of the next page, None on the last."""

    items: list[T]
    following: str | None


@dataclass(frozen=True)
class Route:
    """HTTP method and path of a route; of several paths, the first with all its names in braces given is used."""

    method: str
    paths: tuple[str, ...]
    repeatable: bool

    def __call__(self, read: Callable[[Answer], T], *, names: Mapping[str, Any], **fields: Any) -> Call[T]:
        """Return the call.

        Args:
            read: Converts the answer to the result.
            names: Values of the names in braces; None if a name is not given.
            **fields: Other fields of `Call`. `params` that are None are omitted.
        """
        given = {name: str(value) for name, value in names.items() if value is not None}
        path = next(path for path in self.paths if set(_NAMES.findall(path)) == set(given))
        filled = path.format_map({name: quote(value, safe="") for name, value in given.items()})
        params = {name: value for name, value in fields.pop("params", {}).items() if value is not None}
        return Call(
            method=self.method, path=filled, read=read, params=params, **{"repeatable": self.repeatable, **fields}
        )


_NAMES = re.compile(r"{(\w+)}")


def route(
    method: str, *paths: str, repeatable: bool | None = None
) -> Callable[[Callable[Concatenate[Route, P], Call[T]]], Callable[P, Call[T]]]:
    """Decorate a function of a `Route` and arguments, so that it returns the call for these arguments.

    Args:
        method: HTTP method.
        *paths: Paths with names in braces.
        repeatable: Whether the request may be sent again if its answer is lost. Default: all but POST.
    """
    at = Route(method, paths, method != "POST" if repeatable is None else repeatable)

    def decorate(make: Callable[Concatenate[Route, P], Call[T]]) -> Callable[P, Call[T]]:
        @wraps(make)
        def made(*args: P.args, **kwargs: P.kwargs) -> Call[T]:
            return make(at, *args, **kwargs)

        signature = inspect.signature(make)
        _, *rest = signature.parameters.values()
        made.__signature__ = signature.replace(parameters=rest)  # type: ignore[attr-defined]  # shown by `help`
        for path in paths:
            ROUTES[method, path] = make.__name__
        return made

    return decorate


_making = Lock()


class _Listed(msgspec.Struct, Generic[T]):
    items: list[T]
    next_cursor: str | None = None


def decoder(kind: type[T], hook: Callable[[Any, Any], Any] | None = None) -> msgspec.json.Decoder[T]:
    """Return a decoder of JSON as a type. hook: `dec_hook` of msgspec, for types that msgspec does not know.

    A lock serialises this: if two threads are the first to use a type of msgspec, the process can crash (SIGSEGV).
    """
    with _making:
        return msgspec.json.Decoder(kind, dec_hook=hook)


def record(kind: type[R]) -> Callable[[Answer], R]:
    """Return a function that reads a record of the API."""
    decode = decoder(kind).decode
    return lambda answer: decode(answer.body)


def page(kind: type[R]) -> Callable[[Answer], Page[R]]:
    """Return a function that reads one page of a list of records."""
    decode = decoder(_Listed[kind]).decode  # type: ignore[valid-type]

    def read(answer: Answer) -> Page[R]:
        listed: _Listed[R] = decode(answer.body)
        return Page(listed.items, listed.next_cursor)

    return read


def document(answer: Answer) -> Any:
    """Read an answer as plain JSON."""
    return json.loads(answer.body)


def nothing(answer: Answer) -> None:
    """Read an empty answer."""


def given(**values: Any) -> dict[str, Any]:
    """Return the values that are not None."""
    return {name: value for name, value in values.items() if value is not None}


def split_name(model: str, version: int | None = None, alias: str | None = None) -> tuple[str, dict[str, Any]]:
    """Return the name of a model, and its version or alias as fields of a request.

    Args:
        model: `NAME`, `NAME@3` or `NAME@ALIAS`.
        version: Version number.
        alias: Alias.

    Raises:
        ValueError: The name has a version or an alias, and another one is given.

    Example:
        >>> split_name("my-arm@production")
        ('my-arm', {'alias': 'production'})
    """
    name, at, which = model.partition("@")
    if not at:
        return model, given(version=version, alias=alias)
    if version is not None or alias is not None:
        raise ValueError(f"{model!r} names a version already: omit `version` and `alias`.")
    return name, {"version": int(which)} if which.isdecimal() else {"alias": which}


_RESULT = re.compile(r"Call\[(?:Page\[(?P<item>.+)\]|(?P<one>.+))\]")


def bound(method: Callable[P, T], result: str = "{}") -> Callable[P, T]:
    """Give a wrapper of a call function the signature of a method, for `help`, and return it.

    result: its return annotation, with {} for the call's result or the item of its page.
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
    """Return a new unique idempotency key."""
    return token_hex(16)
