"""What crosses the border: every object of the API, declared once."""
