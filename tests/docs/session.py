"""A reader of the documentation: a service of their own, a folder, a shell, and a Python that keeps its variables."""

import json
import os
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Self

import httpx

from tests.docs.blocks import ROOT, Block
from tests.docs.expected import compare
from tests.service.data import DEADLINE, eventually
from tests.service.server import free_port

WRITTEN = "127.0.0.1:8000"
"""Address of the service as the documentation has it."""
PATIENCE, STARTING = 600, 180
"""Seconds that a block may take, and the start of the service."""
NOTEBOOK = Path(__file__).with_name("notebook.py")


class Reader:
    """A service on an empty home, started as the documentation says, and environment and folders of who uses it."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.address = folder, f"127.0.0.1:{free_port()}"
        self.environment = {
            **os.environ,
            "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
            "LIPSERVE_HOME": str(folder / "home"),
            "LIPSERVE_PORT": self.address.rpartition(":")[2],
            "LIPSERVE_URL": f"http://{self.address}",
        }
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        path = self.folder / "service.log"
        log = self._stack.enter_context(path.open("wb"))
        command = ["bash", "-c", "exec .venv/bin/lipserve serve"]
        service = subprocess.Popen(command, cwd=self.place("service"), env=self.environment, stdout=log, stderr=log)
        self._stack.callback(_end, service)

        def ready() -> bool:
            assert service.poll() is None, path.read_text()
            try:
                return httpx.get(f"http://{self.address}/health/ready").status_code == httpx.codes.OK
            except httpx.TransportError:
                return False

        try:
            eventually(ready, STARTING)
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

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
        self._said, self._python = "", None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._python is not None:
            _end(self._python)

    def run(self, block: Block) -> None:
        """Do what a block says; raise AssertionError where it fails, or prints something else than is shown."""
        text = block.text.replace(WRITTEN, self._reader.address)
        if block.language == "json":
            compare(json.loads(self._said), block.text, block.place)
        elif block.language == "python":
            self._said = self._in_python(text, block.place)
        elif not block.serves:  # it does already
            self._said = self._in_shell(text, block.place)

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
        said = json.loads(self._python.stdout.readline())
        assert said["error"] is None, f"{place}\n{text}\n{said['error']}"
        return str(said["printed"])


def _end(process: subprocess.Popen[bytes] | subprocess.Popen[str]) -> None:
    for stream in (process.stdin, process.stdout):
        if stream is not None:
            stream.close()
    process.terminate()
    try:
        process.wait(DEADLINE)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
