"""Uploaded URDFs and built-in robot profiles."""
