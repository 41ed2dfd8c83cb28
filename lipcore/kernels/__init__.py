"""Torque kernels, one idea a file."""
