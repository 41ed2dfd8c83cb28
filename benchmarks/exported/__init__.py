"""A model as C, compiled and timed beside Pinocchio's recursive Newton–Euler."""
