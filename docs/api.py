"""Writes docs/reference/api.md from the OpenAPI document: `python docs/api.py`. A test fails if the page differs."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from service.api.limits.requests import body_limit, body_limits
from service.api.openapi import METHODS
from service.app import create_app
from service.foundation.settings import Settings

TARGET = Path(__file__).parent / "reference/api.md"
HEAD = """# API reference

All routes of the HTTP API, generated from its OpenAPI document. The service returns the document at `/openapi.json`;
try the routes at `/docs`. Units are SI: rad, rad/s, rad/s², N·m (prismatic joints: m, m/s, m/s², N). "Scope" is the
scope that an API key needs, if the service requires keys. See also [error codes](../errors.md), and for WebSockets
[in a control loop](../control-loop.md).

"""
Document = dict[str, Any]


def document() -> str:
    """Return the page."""
    api = create_app().openapi()
    return HEAD + "\n".join([*_contents(api), *_routes(api), *_schemas(api)]).rstrip() + "\n"


def _anchor(heading: str) -> str:
    """Return the anchor of a heading on GitHub and in MkDocs."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def _operations(api: Document) -> dict[str, list[tuple[str, str, Document]]]:
    """Return operations (method, path, operation) by tag, in the order of their paths."""
    found: dict[str, list[tuple[str, str, Document]]] = {}
    for path in sorted(api["paths"]):
        for method in METHODS:
            if operation := api["paths"][path].get(method):
                tag = operation.get("tags", ["other"])[0]
                found.setdefault(tag, []).append((method.upper(), path, operation))
    return dict(sorted(found.items()))


def _contents(api: Document) -> Iterator[str]:
    yield from ("| route | purpose |", "| --- | --- |")
    for operations in _operations(api).values():
        for method, path, operation in operations:
            yield f"| [`{method} {path}`](#{_anchor(f'{method} {path}')}) | {_cell(operation.get('summary', ''))} |"
    yield ""


def _routes(api: Document) -> Iterator[str]:
    for tag, operations in _operations(api).items():
        yield f"## {tag[:1].upper()}{tag[1:]}\n"
        for method, path, operation in operations:
            yield from _route(method, path, operation)


def _route(method: str, path: str, operation: Document) -> Iterator[str]:
    yield f"### {method} {path}\n"
    description = re.sub(r"\s*Scope: [^\n]*$", "", operation.get("description", "")).strip()
    yield f"**{operation.get('summary', '')}.** {_prose(description)}\n".replace("?.**", "?**")
    for scope in operation["security"][-1]["key"] if operation["security"] else ():
        yield f"Scope: `{scope}`.\n"
    if parameters := operation.get("parameters"):
        yield from ("| parameter | in | type | meaning |", "| --- | --- | --- | --- |")
        for each in parameters:
            needed = ", required" if each.get("required") and each["in"] != "path" else ""
            yield f"| `{each['name']}` | {each['in']}{needed} | {_type(each['schema'])} | {_meaning(each)} |"
        yield ""
    if body := operation.get("requestBody"):
        limit = body_limit(body_limits(Settings()), path)
        size = f"{limit >> 20} MiB" if limit >= 1 << 20 else f"{limit >> 10} KiB"
        yield f"Body, at most {size}: {_kinds(body['content'])}\n"
    for status, answer in operation["responses"].items():
        if int(status) < 400:
            yield f"Answer: {status} {_kinds(answer.get('content', {})) or '(nothing)'}\n"


def _kinds(content: Document) -> str:
    return "; ".join(f"`{media}` {_type(each.get('schema', {}))}" for media, each in content.items())


def _schemas(api: Document) -> Iterator[str]:
    yield "## Types\n"
    for name, schema in sorted(api["components"]["schemas"].items()):
        yield f"### {name}\n"
        if description := schema.get("description"):
            yield _prose(description) + "\n"
        if not (fields := schema.get("properties")):
            yield f"{_type(schema)}\n"
            continue
        required = set(schema.get("required", ()))
        yield from ("| field | type | meaning |", "| --- | --- | --- |")
        for field, each in fields.items():
            plain = each.get("default") not in (None, "", [], {})
            default = f" Default: `{_cell(str(each['default']))}`." if plain else ""
            optional = "" if field in required else ", optional"
            yield f"| `{field}` | {_type(each)}{optional} | {_meaning(each)}{default} |"
        yield ""


def _type(schema: Document) -> str:
    """Return a short description of a schema, with links to its types."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f"[{name}](#{_anchor(name)})"
    for several in ("anyOf", "oneOf", "allOf"):
        if several in schema:
            return " or ".join(dict.fromkeys(_type(each) for each in schema[several]))
    if "enum" in schema:
        return ", ".join(f"`{value}`" for value in schema["enum"])
    if "const" in schema:
        return f"`{schema['const']}`"
    kind = schema.get("type", "any")
    if kind == "array":
        return f"list of {_type(schema.get('items', {}))}"
    if kind == "object" and isinstance(values := schema.get("additionalProperties"), dict):
        return f"object of {_type(values)}"
    return " or ".join(kind) if isinstance(kind, list) else str(kind)


def _meaning(each: Document) -> str:
    return _cell(each.get("description") or each.get("schema", {}).get("description") or "")


def _prose(text: str) -> str:
    """Return a text of the document without indentation."""
    return "\n".join(line.strip() for line in text.strip().splitlines())


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


if __name__ == "__main__":
    TARGET.parent.mkdir(exist_ok=True)
    TARGET.write_text(document())
