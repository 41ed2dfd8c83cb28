"""C++ client in a separate process that reads commands line by line: clients/cpp/tests/drive.cpp."""

import json
import os
import subprocess
import threading
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from tests.service.data import DEADLINE


def rows_file(program: Path, rows: np.ndarray, owner: object) -> Path:
    """Write rows for a driven program to a file of this owner."""
    file = program.with_name(f"{program.name}-{id(owner)}.rows")
    file.write_bytes(np.ascontiguousarray(rows, "<f8").tobytes())
    return file


def started(
    program: Path, options: Mapping[str, Any], environment: Mapping[str, str] | None = None
) -> subprocess.Popen[str]:
    """Start a program that reads commands line by line. environment: default is that of this process."""
    return subprocess.Popen(
        [program, *(f"{name}={value}" for name, value in options.items())],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )


class Driver:
    """Driven client. options: fields of `lipserve::Options`; rows: (N, 4, n) q, dq, ddq, tau."""

    def __init__(self, program: Path, rows: np.ndarray | None = None, **options: Any) -> None:
        if rows is not None:
            options |= {"rows": rows_file(program, rows, self), "joints": rows.shape[2]}
        environment = {name: value for name, value in os.environ.items() if not name.startswith("LIPSERVE_")}
        environment |= {name: options.pop(name) for name in list(options) if name.startswith("LIPSERVE_")}
        self.process = started(program, options, environment)
        self._limit = threading.Timer(4 * DEADLINE, self.process.kill)  # a client that hangs fails its test
        self._limit.start()

    def begin(self, line: str) -> None:
        """Send a command."""
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def line(self) -> str:
        """Return the next line of output."""
        assert self.process.stdout is not None
        assert self.process.stderr is not None
        if line := self.process.stdout.readline():
            return line
        raise AssertionError(self.process.stderr.read())

    def end(self) -> dict[str, Any]:
        """Return the report of the command; check that it allocated nothing."""
        while not (line := self.line()).startswith("{"):
            pass
        report: dict[str, Any] = json.loads(line)
        assert report["allocations"] == 0, report
        return report

    def do(self, line: str) -> dict[str, Any]:
        """Send a command and return its report."""
        self.begin(line)
        return self.end()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            _, errors = self.process.communicate("" if self.process.poll() is not None else "end\n", DEADLINE)
            if error is None:  # sanitizers also report at exit
                assert self.process.returncode == 0, errors
        finally:
            self._limit.cancel()
            self.process.kill()
