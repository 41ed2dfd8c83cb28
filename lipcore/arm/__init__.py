"""The arm itself: where its joint axes lie, its masses, and how both are learnt from torque alone."""
