"""Processes for long computations, so that these delay neither control loops nor the control plane."""
