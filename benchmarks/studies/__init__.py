"""Scripts that print the figures of docs/numbers.md."""
