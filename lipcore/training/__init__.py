"""Training: samples in, a model out; `auto` chooses the estimator."""
