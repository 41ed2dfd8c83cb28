"""Data sets: upload, validation, preparation and report."""
