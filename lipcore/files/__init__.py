"""A model as files: written, and read from strangers."""
