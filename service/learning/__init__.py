"""Learning while serving: a durable log of observations, and what follows it."""
