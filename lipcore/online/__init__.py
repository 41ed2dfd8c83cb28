"""Learning from a live stream: exact, reversible, and honest about what it does not explain."""
