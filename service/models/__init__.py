"""Named models and their immutable versions."""
