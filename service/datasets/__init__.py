"""Data sets: upload, validation, preparation, report."""
