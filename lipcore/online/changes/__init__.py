"""A robot that is no longer the one that was learnt, and a model that is led away."""
