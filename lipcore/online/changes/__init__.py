"""Detect that a robot is no longer the one that was learnt, or that a model is drifting away."""
