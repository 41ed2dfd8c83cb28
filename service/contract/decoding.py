"""Fast JSON decoding of pydantic models with arrays. Fields are declared in the models only."""

from __future__ import annotations

from collections.abc import Mapping
from functools import reduce
from operator import or_
from types import GenericAlias, NoneType, UnionType
from typing import Any, Generic, TypeVar, Union, get_args, get_origin

import msgspec
import numpy as np
from msgspec import MsgspecError, Raw, Struct
from numpy.typing import NDArray
from pydantic import BaseModel, PlainValidator, create_model

from service.foundation.errors import InvalidRequestError
from service.foundation.json_text import has_unique_fields

Model = TypeVar("Model", bound=BaseModel)


def struct_of(model: type[BaseModel], types: Mapping[str, Any] | None = None) -> type[Struct]:
    """Make a struct with the fields and defaults of a model, encoded without defaults. types: replacements by field."""
    fields: list[Any] = []
    for name, field in model.model_fields.items():
        default = () if field.is_required() else (field.get_default(call_default_factory=True),)
        fields.append((name, (types or {}).get(name, field.annotation), *default))
    closed = model.model_config.get("extra") == "forbid"
    return msgspec.defstruct(model.__name__, fields, kw_only=True, omit_defaults=True, forbid_unknown_fields=closed)


class HotDecoder(Generic[Model]):
    """Decoder of a model's JSON bodies that returns None for a body that may be invalid.

    The caller then decodes this body with pydantic, which is slower and reports the error.

    msgspec decodes the arrays; the `json_schema_input_type` of an array's validator declares its JSON type. The model
    validates all other fields, if the body has any.

    apart: whether each array is decoded separately. The interpreter's lock is released in between, so that a control
    loop waits less.
    """

    def __init__(self, model: type[Model], apart: bool = False) -> None:
        fields = model.model_fields.items()
        types = {name: kind for name, field in fields if (kind := _type_in_json(field.rebuild_annotation()))}
        required = {name for name, field in fields if field.is_required()}
        self._model, self._arrays = model, tuple(types)
        unread: dict[str, Any] = dict.fromkeys(types, (Any, None))
        self._others = create_model(model.__name__, __base__=model, **unread)
        self._apart = {name: msgspec.json.Decoder(kind) for name, kind in types.items() if apart}
        struct = struct_of(model, types | dict.fromkeys(self._apart, Raw))
        self._decoder = msgspec.json.Decoder(struct, dec_hook=_read_model)
        self._min_quotes = 2 * len(required) if required <= types.keys() else None
        """Number of quotes in a body with the required arrays only; None if other fields are required."""

    def decode(self, body: bytes) -> Any:
        """Return the decoded fields for `request`; None if the body may be invalid. Arrays may be undecoded."""
        try:
            value = self._decoder.decode(body)
            if body.count(b'"') == self._min_quotes:
                return value
            checked = self._others.model_validate(msgspec.structs.asdict(value))
        except (MsgspecError, RecursionError, ValueError, InvalidRequestError):
            return None
        return checked if has_unique_fields(body) else None

    def request(self, decoded: Any) -> Model | None:
        """Return the decoded object as the model, null in arrays as NaN, or None if an array is empty or ragged."""
        fields = {name: getattr(decoded, name) for name in self._model.model_fields}
        try:
            for name in self._arrays:
                value = fields[name]
                if name in self._apart and value is not None:
                    value = self._apart[name].decode(value)
                fields[name] = None if value is None else _array(value)
        except (MsgspecError, ValueError):
            return None
        return self._model.model_construct(**fields)


def _read_model(kind: Any, value: Any) -> Any:
    return kind.model_validate(value)


def _array(value: Any) -> NDArray[np.float64]:
    array = np.array(value, np.float64, ndmin=1)
    if not array.size:
        raise ValueError("no numbers")
    return array


def _type_in_json(annotation: Any) -> Any:
    """Return the JSON type of a field that a validator turns into an array, None for any other field."""
    members = _members(annotation)
    marks = [mark for member in members for mark in getattr(member, "__metadata__", ())]
    inputs = [mark.json_schema_input_type for mark in marks if isinstance(mark, PlainValidator)]
    kinds = [kind for each in inputs for kind in _members(each)]
    lists = [get_args(kind)[0] for kind in kinds if get_origin(kind) is list]
    if not lists:
        return None
    # msgspec has no union of lists, so the list holds either item; numpy rejects mixed ones
    merged = GenericAlias(list, (reduce(or_, lists),))
    others = [kind for kind in (*kinds, *members) if kind in (float, NoneType)]
    return reduce(or_, others, merged)


def _members(kind: Any) -> tuple[Any, ...]:
    return get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
