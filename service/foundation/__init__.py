"""Settings, errors, environment variables and texts that every room may import."""
