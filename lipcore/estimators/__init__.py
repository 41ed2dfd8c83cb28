"""The estimators: their names, hyperparameters, noise, options, and the input of a training."""
