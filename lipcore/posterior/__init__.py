"""Gaussian posteriors of the torque: exact, and compact from sums over samples."""
