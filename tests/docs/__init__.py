"""Tests of the documentation: what it says to type is typed, what it says is printed is compared."""
