"""Logs, meters and readiness, for every room that reports."""
