"""The live feed of models: measured and predicted rows, and status, for people who watch."""
