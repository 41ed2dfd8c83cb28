"""What clients may take of the machine: sizes, times, connections, rates, disk."""
