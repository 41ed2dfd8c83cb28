"""Coverage-guided fuzzing of the file readers with Atheris: `python -m tests.fuzz TARGET SECONDS`.

TARGET is one of `targets.TARGETS`. New inputs and findings go to build/fuzz; the corpus of the repository is read too.
`python -m tests.fuzz merge TARGET` adds new inputs to the corpus if they reach further code.
"""

from __future__ import annotations

import sys
from pathlib import Path

import atheris

READERS = ["service.datasets", "service.robots", "service.models.archive_reading", "zipfile", "tarfile"]
READERS += ["lipcore.files", "lipcore.profiles", "lipcore.robots"]
with atheris.instrument_imports(include=READERS, enable_loader_override=False):
    from tests.fuzz import targets

CORPUS = Path(__file__).parent / "corpus"
FOLDER = Path("build/fuzz")
MAX_INPUT_BYTES = 32_768
LIMITS = ("-timeout=30", "-rss_limit_mb=3000", "-malloc_limit_mb=4096")
"""Exceeding these is a finding, like any unexpected error."""


def main(arguments: list[str]) -> None:
    """Run the command of the arguments; libFuzzer ends the process."""
    merging = arguments[0] == "merge"
    target = arguments[1] if merging else arguments[0]
    known, found = CORPUS / target, FOLDER / target
    for folder in (known, found):
        folder.mkdir(parents=True, exist_ok=True)
    options = [f"-max_len={MAX_INPUT_BYTES}", *LIMITS, f"-artifact_prefix={found.parent}/{target}-"]
    if merging:
        options += ["-merge=1", str(known), str(found)]
    else:
        options += [f"-max_total_time={arguments[1]}", "-print_final_stats=1", str(found), str(known)]
    atheris.Setup([sys.argv[0], *options], lambda data: targets.run(target, data))
    atheris.Fuzz()


main(sys.argv[1:])
