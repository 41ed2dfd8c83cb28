"""Both planes of a service whose processes are killed and stopped under load."""
