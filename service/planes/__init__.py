"""Two planes: a process that only answers control loops, and one that does everything else."""
