"""What a model's streams measure and what it predicted, for people who watch."""
