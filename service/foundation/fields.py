"""What several rooms take of requests: names for people, rows of numbers, and what the application keeps for routes."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Annotated, Any

import numpy as np
from fastapi import Request
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, ValidationInfo

from service.foundation.errors import invalid_request

LONGEST = 200


def for_people(field: str, name: str) -> str:
    """Return a name; raise InvalidRequestError where it would not be shown as it is, or not be seen at all.

    Control, bidirectional and zero-width characters let one name pass for another, and break logs and terminals.
    """
    if not name.strip() or len(name) > LONGEST or not name.isprintable():
        raise invalid_request(field, name, f"1 to {LONGEST} printable characters")
    return name


def _checked(name: str, info: ValidationInfo) -> str:
    return for_people(info.field_name or "name", name)


NameForPeople = Annotated[str, Field(min_length=1, max_length=LONGEST), AfterValidator(_checked)]


def to_array(name: str, value: Any, read: Callable[[str, list[Any]], list[float]]) -> NDArray[np.float64]:
    """Numbers (n,) or rows of numbers (N, n) as an array; raise InvalidRequestError naming what is wrong.

    read: takes the name and the numbers of one row, and raises InvalidRequestError for what is none.
    """
    if not isinstance(value, list) or not value:
        raise invalid_request(name, value, "a list of numbers, or a list of such lists")
    if not isinstance(value[0], list):
        return np.array(read(name, value))
    width = len(value[0])
    rows = []
    for index, row in enumerate(value):
        if not isinstance(row, list) or len(row) != width:
            raise invalid_request(f"{name}[{index}]", row, f"a list of {width} numbers, as {name}[0] has")
        rows.append(read(f"{name}[{index}]", row))
    return np.array(rows).reshape(len(rows), width)


def of_app(name: str) -> Callable[[Request], Awaitable[Any]]:
    """A dependency of routes: what the running application keeps under this name."""

    async def kept(request: Request) -> Any:
        return getattr(request.app.state, name)

    return kept


BINARY: dict[str, Any] = {"type": "string", "format": "binary"}


def upload_body(description: str, content: dict[str, Any], file: str) -> dict[str, Any]:
    """What the OpenAPI document says of the body of an upload: by media type, or as a form with a file of this kind."""
    form = {"type": "object", "required": ["file"], "properties": {"file": {**BINARY, "description": file}}}
    every = {**content, "multipart/form-data": {"schema": form}}
    return {"requestBody": {"required": True, "description": description, "content": every}}
