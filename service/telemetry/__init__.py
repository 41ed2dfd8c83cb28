"""What any room may report to: logs, meters, readiness."""
