"""Uploaded URDFs and the robots that are known by name."""
