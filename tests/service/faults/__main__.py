"""Kills the service at every point, one after the other: `python -m tests.service.faults [part of a name]`."""

from __future__ import annotations

import sys
import tempfile
import traceback
from functools import partial
from pathlib import Path

from tests.service.faults.points import FIRST_STARTS, POINTS, STARTS
from tests.service.faults.trial import Street, first_start_trial


def main(wanted: str) -> int:
    """Run the points whose names contain a text; print a tally and return the number of failures."""
    failures = 0
    with tempfile.TemporaryDirectory() as folder:
        street = Street(Path(folder))
        trials = {point.name: partial(street.trial, point) for point in POINTS}
        trials |= {f"start: {name}": partial(street.start_trial, fault) for name, fault in STARTS.items()}
        for number, (name, fault) in enumerate(FIRST_STARTS.items()):
            trials[f"first start: {name}"] = partial(first_start_trial, Path(folder) / f"first{number}", fault)
        trials = {name: trial for name, trial in trials.items() if wanted in name}
        for number, (name, trial) in enumerate(trials.items(), 1):
            try:
                said = trial()
            except Exception as error:
                failures += 1
                said = f"FAILED: {type(error).__name__}: {error}"
                traceback.print_exc()
            print(f"{number:3}/{len(trials)}  {name:62} {said}", flush=True)
        street.close()
        print(f"{len(trials) - failures} of {len(trials)} points held; the service was started {street.starts} times")
    return failures


if __name__ == "__main__":
    sys.exit(1 if main(" ".join(sys.argv[1:])) else 0)
