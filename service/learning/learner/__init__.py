"""The learner process: it follows the logs and publishes revisions."""
