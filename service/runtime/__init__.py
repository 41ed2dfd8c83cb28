"""Processes and cluster workers that share the work of the service."""
