"""Torque kernels, one for each file."""
