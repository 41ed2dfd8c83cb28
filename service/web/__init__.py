"""What every request passes: routes, access, limits, metrics, health."""
