"""Replaces field names of the API by command line options in messages of the service."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Mapping
from typing import Any

FLAGS = {
    **{name: f"--{name.replace('_', '-')}" for name in ("joint_names", "torque_constants", "torque_factors")},
    **{name: f"--{name.replace('_', '-')}" for name in ("torque_convention", "joint_types")},
    **{name: f"--{name}" for name in ("robot", "effort", "topic", "delimiter", "cutoff", "filtering", "rate", "gap")},
    **{name: f"--{name}" for name in ("trim", "joints", "form", "model", "estimator", "base", "promotion")},
    **{"drop_joints": "--drop", "columns": "--column", "units": "--unit", "options": "--option"},
    **{"column_names": "--columns", "dt": "--dt", "poses": "--poses", "scale": "--scale", "xacro": "--xacro"},
    **{
        "holdout.share": "--hold-out",
        "holdout.kind": "--hold-out-by",
        "holdout.only": "--hold-out-only",
        "override": "--override",
    },
}
"""Command line options by API field."""
QUANTITIES_BY_NAME = ("columns", "units", "options")
"""Fields with named values; their options have the form name=value and can be repeated."""

_GIVEN = re.compile(rf"\b({'|'.join(QUANTITIES_BY_NAME)})=(?=\{{)")
_VALUE = re.compile(rf"(?<![\w.-])({'|'.join(map(re.escape, FLAGS))})=([^\s{{}}`]*[^\s{{}}`.,;:?!])")
_MARKED = re.compile(rf"`({'|'.join(map(re.escape, FLAGS))})`")
_BARE = re.compile(rf"\b(say|with) ({'|'.join(re.escape(name) for name in FLAGS if '_' in name)})(?![\w\[=])")
_FIELD = re.compile(rf"^({'|'.join(map(re.escape, FLAGS))})(?:\.(\w+))? is ")


def in_shell(text: str) -> str:
    """Replace API fields in a message by options: `units={"q": "deg"}` becomes `--unit q=deg`."""
    text = _FIELD.sub(_field, text)
    text = _VALUE.sub(lambda match: _option(match[1], match[2]), _objects(text))
    text = _MARKED.sub(lambda match: f"`{FLAGS[match[1]]}`", text)
    return _BARE.sub(lambda match: f"{match[1]} {FLAGS[match[2]]}", text)


def _field(match: re.Match[str]) -> str:
    name, part = match[1], match[2]
    if part is None:
        return f"{FLAGS[name]} is "
    return f"{FLAGS[name]} {part} is " if name in QUANTITIES_BY_NAME else match[0]


def _objects(text: str) -> str:
    """Replace fields with a JSON object as value by options."""
    out, at = "", 0
    while (match := _GIVEN.search(text, at)) is not None:
        try:
            given, end = json.JSONDecoder().raw_decode(text, match.end())
        except ValueError:
            out, at = out + text[at : match.end()], match.end()
            continue
        out, at = out + text[at : match.start()] + _named(FLAGS[match[1]], given), end
    return out + text[at:]


def _named(flag: str, given: Mapping[str, Any]) -> str:
    values = ((name, each if isinstance(each, str) else ",".join(each)) for name, each in given.items())
    return " ".join(f"{flag} {shlex.quote(f'{name}={value}')}" for name, value in values)


def _option(name: str, value: str) -> str:
    if value == "true":
        return FLAGS[name]
    return f"{FLAGS[name]}{'=' if value.startswith('-') else ' '}{shlex.quote(value)}"
