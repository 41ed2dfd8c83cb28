"""The paper's experiment on simulated robots: `python -m benchmarks.reproduce`."""
