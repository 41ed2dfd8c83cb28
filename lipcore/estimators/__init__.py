"""The estimators: which there are, their hyperparameters, noise, options, and what a training is given."""
