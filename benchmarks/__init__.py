"""Benchmarks, not part of the wheel: `python -m benchmarks --help`, `python -m benchmarks.reproduce --help`."""

from __future__ import annotations

import sys

import typer

from service.cli.consoles import explain, print_error


def run(app: typer.Typer, expected: tuple[type[Exception], ...], name: str) -> None:
    """Run a command line; print errors that a user can act on, the `expected` ones among them, without a traceback."""
    try:
        app(prog_name=name)
    except Exception as error:
        words = explain(error, expected)
        if words is None:
            raise
        print_error(words)
        sys.exit(1)
