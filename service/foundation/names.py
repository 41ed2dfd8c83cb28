"""Names for people: of data sets, robots and keys."""

from __future__ import annotations

from typing import Annotated

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
