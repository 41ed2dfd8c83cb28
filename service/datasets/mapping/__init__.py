"""Mapping a file's columns to positions, velocities, accelerations and torques of joints, in SI units."""
