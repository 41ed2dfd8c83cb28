"""A model that leaves: as a URDF, and as C."""
