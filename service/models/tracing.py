"""Exports in formats that trace the model's function. A trace takes seconds of Python, so it has its own process."""

from __future__ import annotations

import multiprocessing
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from lipcore.export.formats import FORMATS
from lipcore.export.origin import ModelOrigin
from lipcore.files import persistence
from lipcore.vocabulary import ExportFormat
from service.foundation.errors import NotReadyError
from service.runtime.process import SERVING_THREADS, ProcessOptions, start_process
from service.telemetry import logs

NICENESS = 5
"""Serving has priority over exports."""


def write_in_process(
    kind: ExportFormat, files: Mapping[str, bytes], parameters: Mapping[str, Any], origin: ModelOrigin
) -> dict[str, bytes]:
    """Return the files of a model in a format. files: those of the stored model. The call blocks: use a thread.

    Raise ValueError for a model that the format cannot express, MissingExtraError if the format's library is missing,
    and NotReadyError if the process ends early.
    """
    place = ProcessOptions(SERVING_THREADS, NICENESS, log=logs.current_options())
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context, initializer=start_process, initargs=(place,)) as pool:
        try:
            return pool.submit(_write, kind, dict(files), dict(parameters), origin).result()
        except BrokenProcessPool:
            reason = (
                f"The model cannot be written as {kind} at present: the process ended early, perhaps out of memory."
            )
            raise NotReadyError(reason) from None


def _write(
    kind: ExportFormat, files: Mapping[str, bytes], parameters: Mapping[str, Any], origin: ModelOrigin
) -> dict[str, bytes]:
    return FORMATS[kind].write(persistence.decode(files), parameters, origin)
