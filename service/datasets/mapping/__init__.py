"""From what a file calls its columns to positions, velocities, accelerations and torques of joints, in SI units."""
