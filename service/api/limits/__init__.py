"""Limits of requests: number, rate, size and time, and uploads within the limits of the disk."""
