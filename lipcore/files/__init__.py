"""A model as files: writing them, and reading them from untrusted sources."""
