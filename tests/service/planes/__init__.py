"""The two planes of the service."""
