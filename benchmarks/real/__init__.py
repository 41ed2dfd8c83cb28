"""Recordings of real arms: the default beside what others try first. `python -m benchmarks real FOLDER`."""
