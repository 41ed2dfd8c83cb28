"""`python -m benchmarks scale`: several services and workers, with a database, a store and a scheduler of their own."""
