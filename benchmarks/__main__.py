"""`python -m benchmarks`: latency, learning, real recordings, uploads, load, scale, and what kills cost."""

from benchmarks import run
from benchmarks.command import ERRORS, app

if __name__ == "__main__":
    run(app, ERRORS, "python -m benchmarks")
