"""`python -m benchmarks.reproduce`."""

from benchmarks import run
from benchmarks.reproduce.command import ERRORS, app

if __name__ == "__main__":
    run(app, ERRORS, "python -m benchmarks.reproduce")
