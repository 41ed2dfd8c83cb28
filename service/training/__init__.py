"""Training jobs, run in another process."""
