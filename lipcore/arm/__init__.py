"""The rigid arm: its geometry, masses and friction, learnt from torque alone."""
