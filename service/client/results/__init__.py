"""Results whose numbers are arrays."""
