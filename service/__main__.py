"""The command `lipserve`, also `python -m service`.

It imports nothing of ours before it runs: spawned processes import their parent's main module again, and training
processes shall take their place on the machine before anything else is loaded (see `compute.process`).
"""

from __future__ import annotations

import gc


def main() -> None:
    """Run the command line."""
    # what is imported stays: searching it for garbage would take a fifth of a start, and 40 ms of the loop's time later
    gc.disable()
    from service.cli import main as command  # noqa: PLC0415

    gc.freeze()
    gc.enable()
    command()


if __name__ == "__main__":
    main()
