"""`python -m benchmarks real FOLDER`: recordings of real arms, default options and other methods."""
