"""`python -m benchmarks`: latency, online learning, real recordings, uploads, load, scale and durability."""

from benchmarks import run
from benchmarks.command import ERRORS, app

if __name__ == "__main__":
    run(app, ERRORS, "python -m benchmarks")
