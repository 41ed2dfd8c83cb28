"""The results of cells on disk, one JSON line each, so that a run can be resumed."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from benchmarks.reproduce.experiment import Cell, CellResult, Experiment

FILE = "cells.jsonl"


class ResultsError(ValueError):
    """The folder has results of other settings, or is in use by another run."""


class Results:
    """Results in a folder that this process locks.

    The first line of the file has the settings, each further line a cell.
    """

    def __init__(self, folder: Path, experiment: Experiment) -> None:
        """Open or create the file; raise ResultsError for other settings, a damaged file or a folder in use."""
        folder.mkdir(parents=True, exist_ok=True)
        self.path, self.hash = folder / FILE, experiment.hash
        self._found: dict[Cell, CellResult] = {}
        self._file = self.path.open("a+b")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._file.close()
            raise ResultsError(f"The folder {folder} of --out is in use by another run.") from None
        try:
            self._read(experiment.settings())
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Results:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def add(self, result: CellResult) -> None:
        """Append a result durably."""
        self._write({"settings": self.hash, "result": json.loads(result.model_dump_json())})
        self._found[result.cell] = result

    def of(self, cells: Sequence[Cell]) -> list[CellResult]:
        """Return the results without error."""
        found = (self._found.get(cell) for cell in cells)
        return [result for result in found if result is not None and result.error is None]

    def failed(self, cells: Sequence[Cell]) -> list[CellResult]:
        """Return the results of failed cells."""
        return [self._found[cell] for cell in cells if cell in self._found and self._found[cell].error is not None]

    def missing(self, cells: Sequence[Cell]) -> list[Cell]:
        """Return the cells without a result, and failed ones."""
        done = {result.cell for result in self.of(cells)}
        return [cell for cell in cells if cell not in done]

    def _read(self, settings: dict[str, Any]) -> None:
        self._file.seek(0)
        content = self._file.read()
        complete = content[: content.rfind(b"\n") + 1]
        self._file.truncate(len(complete))  # a killed run leaves an incomplete last line
        lines = complete.splitlines()
        if not lines:
            self._write({"settings": self.hash, "of": settings})
            return
        for number, line in enumerate(lines, start=1):
            try:
                entry = json.loads(line)
                found, result = entry["settings"], entry.get("result")
                if number == 1 and found != self.hash:
                    raise ResultsError(self._differing(entry["of"], settings))
                if found != self.hash:
                    raise ResultsError(f"Line {number} of {self.path} has results of other settings. {_REMEDY}")
                if number > 1:
                    parsed = CellResult.model_validate(result)
                    self._found[parsed.cell] = parsed
            except (json.JSONDecodeError, KeyError, TypeError, AttributeError, ValidationError) as error:
                raise ResultsError(
                    f"Line {number} of {self.path} is not a result of this command. {_REMEDY}"
                ) from error

    def _differing(self, found: dict[str, Any], settings: dict[str, Any]) -> str:
        flat_found, flat = _flat(found), _flat(settings)
        names = [name for name in flat_found | flat if flat_found.get(name) != flat.get(name)]
        changes = "; ".join(f"{name} was {flat_found.get(name)}, now {flat.get(name)}" for name in names)
        return f"{self.path} has results of other settings ({changes}). {_REMEDY}"

    def _write(self, entry: dict[str, Any]) -> None:
        self._file.write(json.dumps(entry).encode() + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())


_REMEDY = "Choose another folder with --out, or delete that file."


def _flat(settings: dict[str, Any]) -> dict[str, Any]:
    options = settings.get("options") or {}
    return {**settings, **{f"options.{name}": value for name, value in options.items()}, "options": None}
