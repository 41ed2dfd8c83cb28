"""The log of observations, and what keeps it short."""
