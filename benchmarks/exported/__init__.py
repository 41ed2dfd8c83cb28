"""Latency and accuracy of a model exported as C, with Pinocchio's recursive Newton–Euler as the baseline."""
