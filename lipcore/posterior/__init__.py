"""Gaussian posteriors of the torque: exact, and compact ones made of sums over samples."""
