"""The estimator `auto`: several are trained, and the one is taken that predicts best what it has not seen."""
