"""A trained model, and what it says of torque, energies, dynamics and its own parameters."""
