"""The OpenAPI document restricted to existing resources, so that generated requests are not all rejected with 404."""

from copy import deepcopy
from typing import Any

METHODS = ("get", "put", "post", "delete")
NUMBERS = ("q", "dq", "ddq", "tau")


def narrowed(
    document: dict[str, Any], known: dict[str, list[Any]], places: tuple[str, ...] = ("path",)
) -> dict[str, Any]:
    """Restrict parameters of these names to known values. A query may filter by any value."""
    document = deepcopy(document)
    for path, operations in document["paths"].items():
        for method in METHODS:
            for parameter in operations.get(method, {}).get("parameters", []):
                narrow = parameter["name"] in known and parameter["in"] in places
                if narrow and (method, path) != ("delete", "/v1/models/{model}"):
                    parameter["schema"] = {"enum": known[parameter["name"]]}
    return document


def fitting(document: dict[str, Any], known: dict[str, list[Any]], joints: int) -> dict[str, Any]:
    """Restrict fields of bodies to known values as well, and fit motions to a robot."""
    document = narrowed(document, known, ("path", "query"))
    row = {"type": "array", "items": {"type": "number", "minimum": -3, "maximum": 3}}
    row |= {"minItems": joints, "maxItems": joints}
    fields = {name: {"enum": values} for name, values in known.items()} | dict.fromkeys(NUMBERS, row)
    fields["datasets"] = {"type": "array", "items": {"enum": known["dataset"]}, "minItems": 1, "maxItems": 1}
    for schema in _bodies(document):
        properties = schema.get("properties", {})
        properties |= {name: fields[name] for name in properties if name in fields}
    return document


def _bodies(document: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the schemas of JSON request bodies."""
    result = []
    for operations in document["paths"].values():
        for method in METHODS:
            content = operations.get(method, {}).get("requestBody", {}).get("content", {})
            reference = content.get("application/json", {}).get("schema", {}).get("$ref")
            if reference is not None:
                result.append(document["components"]["schemas"][reference.rpartition("/")[2]])
    return result
