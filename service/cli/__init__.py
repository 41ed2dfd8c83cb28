"""Command line `lipserve`: `main` lists the commands, the other modules hold them."""

from service.cli.main import app, main

__all__ = ["app", "main"]
