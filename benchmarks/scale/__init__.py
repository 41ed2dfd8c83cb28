"""`python -m benchmarks scale`: several services and workers with PostgreSQL, S3 and Dask."""
