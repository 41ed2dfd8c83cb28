"""What everything may import: settings, errors, names, states."""
