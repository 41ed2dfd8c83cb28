"""Keys and scopes in the OpenAPI document."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI

from service.web.access.scopes import SCOPES, TABLE

SCHEME = "key"
DESCRIPTION = "An API key with scopes, `Authorization: Bearer lip_…`:\n\n" + "\n".join(
    f"- `{scope}`: {allows}" for scope, allows in SCOPES.items()
)


def install(app: FastAPI, keys_needed: bool) -> None:
    """Complete the document that the application makes of its routes; as `add_scopes`."""
    made = app.openapi

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            add_scopes(made(), keys_needed)
        return made()

    app.openapi = openapi  # type: ignore[method-assign]


def add_scopes(document: dict[str, Any], keys_needed: bool) -> None:
    """Write the scheme of keys into the document, and into every operation the scope that it needs.

    keys_needed: whether the service that is described asks for keys; one that does not takes requests without as well.
    """
    schemes = document.setdefault("components", {}).setdefault("securitySchemes", {})
    schemes[SCHEME] = {"type": "http", "scheme": "bearer", "description": DESCRIPTION}
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            scope = TABLE.get((method.upper(), path))
            if scope is None:
                operation["security"] = []
                continue
            operation["security"] = [{SCHEME: [scope]}] if keys_needed else [{}, {SCHEME: [scope]}]
            operation["description"] = f"{operation.get('description', '')}\n\nScope: `{scope}`.".strip()
