"""Names that a shell completes: those of a running service, if it answers within a second; else none."""

from __future__ import annotations

import os
from collections.abc import Callable
from http.client import HTTPException
from typing import Any
from urllib.parse import quote

import typer

from service.cli.asking import ask
from service.foundation.settings import DEFAULT_URL

Names = list[str | tuple[str, str]]
"""What may stand there, with what it is."""


def models(context: typer.Context) -> Names:
    """Names of models."""
    return _listed(context, "/v1/models?limit=100", lambda each: (each["name"], f"version {each['serving_version']}"))


def datasets(context: typer.Context) -> Names:
    """Ids of data sets with their names."""
    return _listed(context, "/v1/datasets?limit=100", lambda each: (each["id"], each["name"]))


def jobs(context: typer.Context) -> Names:
    """Ids of jobs with what they train."""
    return _listed(context, "/v1/jobs?limit=100", lambda each: (each["id"], f"{each['state']}: {each['model']}"))


def versions(context: typer.Context) -> Names:
    """Versions of the model that the command line names."""
    return [(str(each["version"]), each["estimator"]) for each in _model(context).get("versions", ())]


def aliases(context: typer.Context) -> Names:
    """Aliases of the model that the command line names."""
    return [("serving", "what answers"), *((name, f"version {at}") for name, at in _model(context)["aliases"].items())]


def _model(context: typer.Context) -> dict[str, Any]:
    name = context.params.get("model")
    found = _asked(context, f"/v1/models/{quote(name, safe='')}") if name else None
    return found if isinstance(found, dict) else {"aliases": {}}


def _listed(context: typer.Context, path: str, name: Callable[[dict[str, Any]], tuple[str, str]]) -> Names:
    found = _asked(context, path)
    return [name(each) for each in found["items"]] if isinstance(found, dict) else []


def _asked(context: typer.Context, path: str) -> Any:
    url = context.params.get("url") or os.environ.get("LIPSERVE_URL") or DEFAULT_URL
    try:
        return ask(url, path)
    except (OSError, HTTPException, ValueError):
        return None
