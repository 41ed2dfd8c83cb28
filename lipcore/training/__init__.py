"""Training of models from samples; `auto` chooses the estimator."""
