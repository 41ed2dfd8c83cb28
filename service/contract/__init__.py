"""Objects of the API, each declared once."""
