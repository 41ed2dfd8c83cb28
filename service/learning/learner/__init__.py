"""The learner process: it follows the log and publishes what it says."""
