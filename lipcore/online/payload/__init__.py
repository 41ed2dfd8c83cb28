"""Estimate the payload of a stream's arm, and distinguish it from contacts and changed friction."""
