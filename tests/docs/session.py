"""Runs the blocks of a documentation page in a folder, with a shell and a Python process, and checks their output."""

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

DOCUMENTED_ADDRESS = "127.0.0.1:8000"
"""Address of the service in the documentation."""
BLOCK_TIMEOUT_S = 600
"""Timeout of a block, s."""
NOTEBOOK = Path(__file__).with_name("notebook.py")


class BlockRunner:
    """Environment and folders to run blocks against a service."""

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
        """Make a folder with the parts of a checkout that pages mention."""
        made = self.folder / name
        made.mkdir()
        (made / ".venv").symlink_to(sys.prefix)
        (made / "models").symlink_to(ROOT / "models")
        return made


class Session:
    """Runs the blocks of one page in order. Each shell block gets a new bash in the folder of the page."""

    def __init__(self, runner: BlockRunner, name: str) -> None:
        self._runner, self._work = runner, runner.place(name)
        self._output, self._python = "", None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._python is not None:
            self._python.kill()
            self._python.communicate()

    def run(self, block: Block) -> None:
        """Run a block; raise AssertionError if it fails, or if its output differs from the page."""
        text = block.text.replace(DOCUMENTED_ADDRESS, self._runner.address)
        if block.language == "json":
            check_output(json.loads(self._output), block.text, block.place)
        elif block.language == "python":
            self._output = self._in_python(text, block.place)
        elif not block.serves:  # the service is running
            self._output = self._in_shell(text, block.place)

    def _in_shell(self, text: str, place: str) -> str:
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", text],
            cwd=self._work,
            env=self._runner.environment,
            capture_output=True,
            text=True,
            timeout=BLOCK_TIMEOUT_S,
            check=False,
        )
        assert done.returncode == 0, f"{place} ended with {done.returncode}\n{text}\n{done.stdout}\n{done.stderr}"
        return done.stdout

    def _in_python(self, text: str, place: str) -> str:
        if self._python is None:
            self._python = subprocess.Popen(
                [sys.executable, str(NOTEBOOK)],
                cwd=self._work,
                env=self._runner.environment,
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


def check_output(printed: Any, written: str, place: str) -> None:
    """Raise AssertionError if a value on the page differs from the output, within the digits that it has."""
    _check_equal(printed, json.loads(written, parse_float=Decimal), place)


def _check_equal(printed: Any, written: Any, place: str) -> None:
    if isinstance(written, dict):
        assert isinstance(printed, dict), place
        for name, value in written.items():
            assert name in printed, f"{place}: {name} is not printed, but {list(printed)}"
            _check_equal(printed[name], value, f"{place}, {name}")
    elif isinstance(written, list):
        assert isinstance(printed, list), place
        assert len(printed) == len(written), f"{place}: {len(printed)} printed, {len(written)} written"
        for index, (left, right) in enumerate(zip(printed, written, strict=True)):
            _check_equal(left, right, f"{place}[{index}]")
    elif isinstance(written, Decimal):
        last_digit = Decimal(1).scaleb(int(written.as_tuple().exponent))
        assert abs(Decimal(repr(printed)) - written) <= last_digit, f"{place}: {printed} is written as {written}"
    elif isinstance(written, str) and written.endswith("…"):
        assert str(printed).startswith(written.removesuffix("…")), f"{place}: {printed!r} is written as {written!r}"
    else:
        assert printed == written, f"{place}: {printed!r} is written as {written!r}"
