"""Tests of the files: below a home, and in stores that several services share."""
