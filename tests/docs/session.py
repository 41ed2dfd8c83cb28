"""A reader of the documentation: a folder, a shell, a Python that keeps its variables, and eyes for what is printed."""

import json
import os
import subprocess
import sys
from decimal import Decimal
from pathlib import Path
from typing import Any, Self

from tests.docs.blocks import ROOT, Block
from tests.service import backend
from tests.service.server import Server

WRITTEN = "127.0.0.1:8000"
"""Address of the service as the documentation has it."""
PATIENCE = 600
"""Seconds that a block may take."""
NOTEBOOK = Path(__file__).with_name("notebook.py")


class Reader:
    """Environment and folders of who uses a service on an empty home."""

    def __init__(self, folder: Path, server: Server) -> None:
        self.folder, self.address = folder, f"127.0.0.1:{server.port}"
        self.environment = {
            **os.environ,
            **backend.environment(server.home),
            "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
            "LIPSERVE_HOME": str(server.home),
            "LIPSERVE_PORT": str(server.port),
            "LIPSERVE_URL": server.url,
        }

    def place(self, name: str) -> Path:
        """A new folder with what a checkout has that pages name."""
        made = self.folder / name
        made.mkdir()
        (made / ".venv").symlink_to(sys.prefix)
        (made / "models").symlink_to(ROOT / "models")
        return made


class Session:
    """Does what blocks of one page say, in their order. Each of shell is a bash of its own in the page's one folder."""

    def __init__(self, reader: Reader, name: str) -> None:
        self._reader, self._work = reader, reader.place(name)
        self._printed, self._python = "", None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._python is not None:
            self._python.kill()
            self._python.communicate()

    def run(self, block: Block) -> None:
        """Do what a block says; raise AssertionError where it fails, or prints something else than is written."""
        text = block.text.replace(WRITTEN, self._reader.address)
        if block.language == "json":
            compare(json.loads(self._printed), block.text, block.place)
        elif block.language == "python":
            self._printed = self._in_python(text, block.place)
        elif not block.serves:  # it does already
            self._printed = self._in_shell(text, block.place)

    def _in_shell(self, text: str, place: str) -> str:
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", text],
            cwd=self._work,
            env=self._reader.environment,
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=False,
        )
        assert done.returncode == 0, f"{place} ended with {done.returncode}\n{text}\n{done.stdout}\n{done.stderr}"
        return done.stdout

    def _in_python(self, text: str, place: str) -> str:
        if self._python is None:
            self._python = subprocess.Popen(
                [sys.executable, str(NOTEBOOK)],
                cwd=self._work,
                env=self._reader.environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
        assert self._python.stdin is not None
        assert self._python.stdout is not None
        self._python.stdin.write(json.dumps(text) + "\n")
        self._python.stdin.flush()
        answer = json.loads(self._python.stdout.readline())
        assert answer["error"] is None, f"{place}\n{text}\n{answer['error']}"
        return str(answer["printed"])


def compare(printed: Any, written: str, place: str) -> None:
    """Raise AssertionError where a value that a page shows is not the one printed, to the digits that are written."""
    _same(printed, json.loads(written, parse_float=Decimal), place)


def _same(printed: Any, written: Any, place: str) -> None:
    if isinstance(written, dict):
        assert isinstance(printed, dict), place
        for name, value in written.items():
            assert name in printed, f"{place}: {name} is not printed, but {list(printed)}"
            _same(printed[name], value, f"{place}, {name}")
    elif isinstance(written, list):
        assert isinstance(printed, list), place
        assert len(printed) == len(written), f"{place}: {len(printed)} printed, {len(written)} written"
        for index, (left, right) in enumerate(zip(printed, written, strict=True)):
            _same(left, right, f"{place}[{index}]")
    elif isinstance(written, Decimal):
        last_digit = Decimal(1).scaleb(int(written.as_tuple().exponent))
        assert abs(Decimal(repr(printed)) - written) <= last_digit, f"{place}: {printed} is written as {written}"
    elif isinstance(written, str) and written.endswith("…"):
        assert str(printed).startswith(written.removesuffix("…")), f"{place}: {printed!r} is written as {written!r}"
    else:
        assert printed == written, f"{place}: {printed!r} is written as {written!r}"
