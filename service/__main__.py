"""The command `lipserve`, also `python -m service`.

It imports nothing of ours before it runs, because spawned processes import their parent's main module again. Training
processes must set their options before they import anything else (see `service.runtime.process`).
"""

from __future__ import annotations

import gc
import sys


def main() -> None:
    """Run the command line."""
    # imports are permanent: their garbage collection would take a fifth of a start, and later 40 ms of the loop
    gc.disable()
    if sys.argv[1:2] == ["serve"]:
        from service.runtime.process import SERVING_THREADS, limit_library_threads  # noqa: PLC0415

        limit_library_threads(SERVING_THREADS)  # before numerics are imported: a process with threads cannot fork
    from service.cli import main as command  # noqa: PLC0415

    gc.freeze()
    gc.enable()
    command()


if __name__ == "__main__":
    main()
