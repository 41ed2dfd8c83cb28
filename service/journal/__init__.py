"""The event log of each model, its snapshots and its retention."""
