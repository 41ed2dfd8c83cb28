"""Learn from a live stream: exact updates, gates for bad rows, and alarms if the robot changes."""
