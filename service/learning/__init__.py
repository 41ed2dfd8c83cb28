"""Learning while serving: the ingest of observations, the learner process, control and the live feed."""
