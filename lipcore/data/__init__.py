"""Samples of motion and torque: how many count, how they are split, and how a model is judged by them."""
