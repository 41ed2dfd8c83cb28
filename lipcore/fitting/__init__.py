"""Fitting: the torque priors to choose from, their options, their hyperparameters and the noise."""
