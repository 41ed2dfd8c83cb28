"""Learning from a live stream: exact, and honest about what it does not explain."""
