"""Samples of motion and torque, their splits, and the metrics of a model on them."""
