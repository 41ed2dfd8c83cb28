"""A trained model: torque, energies, dynamics and physical parameters."""
