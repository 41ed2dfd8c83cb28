"""The command line: `lipserve`. One file per command, imported when it is run; `main` lists them."""

from service.cli.main import app, main

__all__ = ["app", "main"]
