"""Writes the modules that the client shares with the service: `python clients/python/records.py`.

The client depends on neither Pydantic nor the server. Its records have the fields and descriptions of the server's
schemas; other modules are copies of the server's. A test fails if the written files are out of date.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from inspect import cleandoc
from pathlib import Path
from textwrap import indent, wrap
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from service.api.oip import schema as oip
from service.contract import audit, datasets, health, learning, live, models, overview, robots, verdict
from service.contract import jobs as training
from service.contract import observations as observing
from service.contract import payload as payloads

TARGET = Path(__file__).parent / "lipserve"
SERVICE = Path(__file__).parents[2] / "service"
COPIES = {
    "states.py": "contract/states.py",
    "frames.py": "contract/frames.py",
    "media_types.py": "contract/media_types.py",
    "wording.py": "foundation/text.py",
}
"""Modules of the client, and the modules of the service that they copy."""
WIDTH = 120
ROOMS: dict[str, tuple[str, tuple[type[BaseModel], ...]]] = {
    "verdicts": ("Verdicts on models.", (verdict.Verdict, verdict.Thresholds)),
    "datasets": ("Data sets and their reports.", (datasets.Dataset,)),
    "robots": ("Robots.", (robots.Robot, robots.RobotProfile)),
    "models": ("Models, their versions and aliases.", (models.Model, models.Version, models.Alias)),
    "jobs": ("Training jobs.", (training.Job,)),
    "observations": (
        "Observation batches.",
        (
            observing.ObservationResponse,
            learning.Observation,
            learning.ObservationDetail,
            learning.Unlearnt,
            learning.Replayed,
        ),
    ),
    "learning": (
        "Online learning: quality, options, decisions, alarms.",
        (learning.RolledBack, learning.Quality, learning.Learning, learning.Decided, learning.Alarm),
    ),
    "payloads": ("Payloads.", (payloads.Payloads,)),
    "live": ("Events of the live view of a model.", (live.LiveStatus, live.LiveLost)),
    "overview": ("Summaries of models.", (overview.ModelOverview,)),
    "audit": ("Audit log.", (audit.AuditEntry,)),
    "server": (
        "State of the service, and answers of the Open Inference Protocol.",
        (
            health.Health,
            health.Live,
            health.Ready,
            oip.ServerMetadata,
            oip.ServerLive,
            oip.ServerReady,
            oip.ModelMetadata,
            oip.ModelReady,
        ),
    ),
}
"""Docstring and records of each module; records that are nested in these are added."""
SCALARS = {"string": "str", "integer": "int", "number": "float", "boolean": "bool", "null": "None"}
Schema = Mapping[str, Any]


def documents() -> dict[str, str]:
    """Return the text of every written module, by its path in the client."""
    roots = [(kind, "serialization") for _, kinds in ROOMS.values() for kind in kinds]
    _, document = models_json_schema(roots)  # type: ignore[arg-type]
    known: dict[str, Schema] = document["$defs"]
    home: dict[str, str] = {}
    made = {name: (SERVICE / path).read_text("utf-8") for name, path in COPIES.items()}
    for room, (text, kinds) in ROOMS.items():
        reached = list(dict.fromkeys(name for kind in kinds for name in _reached(kind.__name__, known)))
        own = [name for name in reached if name not in home]
        home |= dict.fromkeys(own, room)
        classes = "\n\n".join(_record(name, known[name]) for name in own)
        others = {n: home[n] for n in reached if n not in own and re.search(rf"\b{n}\b", classes)}
        made[f"records/{room}.py"] = _formatted(_head(text, classes, others) + classes)
    return made


def _reached(name: str, known: Mapping[str, Schema]) -> Iterator[str]:
    """Yield the names of nested records, then that of the record itself."""
    for part in _references(known[name].get("properties", {})):
        yield from _reached(part, known)
    yield name


def _references(node: Any) -> Iterator[str]:
    if isinstance(node, Mapping):
        if "$ref" in node:
            yield _named(node)
        for value in node.values():
            yield from _references(value)
    elif isinstance(node, list):
        for value in node:
            yield from _references(value)


def _named(schema: Schema) -> str:
    return str(schema["$ref"]).rpartition("/")[2]


def _head(text: str, classes: str, others: Mapping[str, str]) -> str:
    written = f"{text} Written by `python clients/python/records.py`."
    lines = [f'"""{written}"""', "", "from __future__ import annotations", ""]
    if names := [name for name in ("Any", "Literal") if name in classes]:
        lines.append(f"from typing import {', '.join(names)}\n")
    if "field(" in classes:
        lines.append("from msgspec import field\n")
    lines.append("from lipserve.records import Record")
    for room in sorted(set(others.values())):
        lines.append(f"from lipserve.records.{room} import {', '.join(sorted(n for n in others if others[n] == room))}")
    return "\n".join(lines) + "\n\n\n"


def _record(name: str, schema: Schema) -> str:
    fields: Mapping[str, Schema] = schema.get("properties", {})
    lines = [f"class {name}(Record, frozen=True, kw_only=True):", indent(_described(schema, fields), "    ")]
    for field, each in fields.items():
        default = "" if field in schema.get("required", ()) else f" = {_default(each.get('default'))}"
        lines.append(f"    {field}: {_type(each)}{default}")
    return "\n".join(lines) + "\n"


def _default(value: Any) -> str:
    if value in ([], {}):
        return f"field(default_factory={type(value).__name__})"
    return repr(value)


def _described(schema: Schema, fields: Mapping[str, Schema]) -> str:
    described = [f"{name}: {each['description']}" for name, each in fields.items() if "description" in each]
    text = cleandoc(schema["description"])
    if not described:
        return f'"""{text}"""'
    listed = [line for each in described for line in wrap(each, WIDTH - 4, subsequent_indent="    ")]
    return "\n".join([f'"""{text}', "", *listed, '"""'])


def _type(schema: Schema) -> str:
    """Return the Python annotation of a schema."""
    if "$ref" in schema:
        return _named(schema)
    if "anyOf" in schema:
        return " | ".join(_type(each) for each in schema["anyOf"])
    if "const" in schema or "enum" in schema:
        return f"Literal[{', '.join(map(repr, schema.get('enum', [schema.get('const')])))}]"
    kind = schema.get("type")
    if kind == "array":
        return f"list[{_type(schema.get('items', {}))}]"
    if kind == "object":
        values = schema.get("additionalProperties", True)
        return f"dict[str, {_type(values) if isinstance(values, Mapping) else 'Any'}]"
    return "Any" if kind is None else SCALARS[kind]


def _formatted(text: str) -> str:
    command = [sys.executable, "-m", "ruff", "format", "-", "--stdin-filename", str(TARGET / "records/written.py")]
    done = subprocess.run(command, input=text, capture_output=True, text=True, check=True)  # noqa: S603 - fixed
    return done.stdout


if __name__ == "__main__":
    for name, text in documents().items():
        (TARGET / name).write_text(text, "utf-8")
